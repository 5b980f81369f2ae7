"""The command that shows an episode again: ``tog replay``."""

from pathlib import Path
from typing import Annotated

import typer

from tog_drake.files import check_file
from tog_drake.terminal import console_for, say


def replay(
    episode: Annotated[
        Path, typer.Argument(help="Folder of an episode, as given to `tog run --out`.")
    ],
    html: Annotated[
        Path | None, typer.Option(help="Write a page that plays it and needs nothing else.")
    ] = None,
    video: Annotated[
        Path | None, typer.Option(help="Film it: an MP4 of 1280x720 pixels, 30 frames a second.")
    ] = None,
) -> None:
    """Show an episode again as it was: live on localhost until Ctrl-C, as a page, or as a film.

    Nothing is simulated or decided again: the positions of all that moved were recorded.
    """
    from tog_drake.files import write_atomically
    from tog_drake.recording import load_recording
    from tog_drake.replay import show_recording
    from tog_drake.showing import serve

    for option, file, suffix in (("--html", html, ".html"), ("--video", video, ".mp4")):
        if file is not None:
            check_file(file, option, suffixes=(suffix,))
    console = console_for(as_json=False)
    recording = load_recording(episode)
    if html is not None:
        write_atomically(html, show_recording(recording).StaticHtml())
        say(console, f"page: {html}")
    if video is not None:
        from tog_drake.video import write_video

        with console.status("filming ...") as status:
            codec = write_video(
                video, recording, lambda done, all_: status.update(f"filming, {done} of {all_} ...")
            )
        say(console, f"film: {video} ({codec})")
        if codec != "H.264":
            say(
                console,
                f"browsers and VLC play {codec}; for PowerPoint or QuickTime: "
                f"ffmpeg -i {video} -pix_fmt yuv420p {video.with_suffix('.h264.mp4')}",
            )
    if html is None and video is None:
        serve(show_recording(recording), console)

"""The command ``tog``. Heavy imports happen inside the subcommands: ``tog --help`` stays quick."""

import signal
import sys
import traceback
from typing import NoReturn

import typer

from tog_drake.assets_commands import app as assets_app
from tog_drake.benchmark_commands import evaluate_, label, report
from tog_drake.errors import TogError
from tog_drake.hardware_commands import app as hardware_app
from tog_drake.look_commands import diagram, doctor, scenarios, show
from tog_drake.overview import overview
from tog_drake.replay_commands import replay
from tog_drake.run_commands import choose, demo, run
from tog_drake.serve_commands import app as serve_app
from tog_drake.terminal import keep_drake_quiet
from tog_drake.visible_text import visible
from tog_drake.vlm_commands import app as vlm_app
from tog_drake.vlm_commands import prompts
from tog_drake.weights_commands import app as weights_app

app = typer.Typer(
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"color": False},  # nor does typer colour what it says itself
    epilog="Exit status: 0 done or lifted; 1 not so, it says why; 2 bad input; "
    "3 a defect of the program; 130 interrupted.",
    help="Training-free task-oriented grasping for the Franka Panda, in Drake. "
    "Add --debug to any command for a traceback.",
)

for _name, _command, _example in (
    ("run", run, 'tog run --scenario Hammer --task "hand me the hammer"'),
    ("demo", demo, "tog demo --out out/demo"),
    (
        "choose",
        choose,
        "tog choose --rgb color.png --depth depth.png --intrinsics camera.json "
        '--task "hold the red mug by the handle"',
    ),
    ("eval", evaluate_, "tog eval builtin --selectors top-score,oracle --workers 2"),
    ("report", report, "tog report out/eval"),
    ("label", label, "tog label out/eval --sample 60"),
    ("replay", replay, "tog replay out/run --video out.mp4"),
    ("scenarios", scenarios, "tog scenarios"),
    ("show", show, "tog show Hammer --out hammer.html"),
    ("diagram", diagram, "tog diagram Hammer --out hammer.svg"),
    ("doctor", doctor, "tog doctor"),
    ("prompts", prompts, "tog prompts cpg"),
):
    app.command(_name, epilog=f"Example: {_example}")(_command)
app.add_typer(vlm_app, name="vlm")
app.add_typer(assets_app, name="assets")
app.add_typer(weights_app, name="weights")
app.add_typer(serve_app, name="serve")
app.add_typer(hardware_app, name="hardware")


@app.callback()
def _alone(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(overview())


def main() -> None:
    """Runs the command: wrong input ends in one line and exit status 2, Ctrl-C in status 130."""
    debug = "--debug" in sys.argv
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    keep_drake_quiet()
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app(args=arguments, prog_name="tog")
    except _Interrupted:
        sys.stderr.write("interrupted\n")
        sys.exit(130)
    except SystemExit as error:
        if isinstance(error.code, str):  # so ends Drake where a condition of it does not hold
            _fail(error, 2, debug)
        raise
    except (TogError, OSError) as error:
        _fail(error, 2, debug)
    except Exception as error:
        _fail(error, 3, debug)


def _fail(error: BaseException, status: int, debug: bool) -> NoReturn:
    """Says in one line what is wrong, and ends. Status 3: a defect of the program."""
    if debug:
        traceback.print_exc()
    message = " ".join(_told(error).split())
    if status == 3:
        message = f"internal error, {type(error).__name__}: {message} (--debug shows where)"
    sys.stderr.write(f"tog: {visible(message)}\n")
    sys.exit(status)


def _told(error: BaseException) -> str:
    """The message of an error; of one of the system's that names a file, what to do besides."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}; name another, or make room or rights for it"
    return str(error)


class _Interrupted(BaseException):
    """Ctrl-C, kept from the command-line library, which would report it as a failure."""


def _interrupt(signum: int, frame: object) -> None:
    raise _Interrupted


if __name__ == "__main__":
    main()

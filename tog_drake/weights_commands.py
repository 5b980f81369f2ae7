"""The commands about weights of networks: ``tog weights ...``."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tog_drake.options import JsonOption, valid
from tog_drake.terminal import console_for, print_json, say
from tog_drake.weights import CHANGED, CONTACT_GRASPNET, MODELS, Model, Stored, which

if TYPE_CHECKING:
    from rich.console import Console

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Weights of networks: where they come from, their licence, and what is stored here.",
)


@app.command("list", epilog="Example: tog weights list --json")
def list_(as_json: JsonOption = False) -> None:
    """List the networks: source and licence of their weights, and what is stored of them."""
    from tog_drake.weights import stored, weights_dir

    console = console_for(as_json)
    found = {name: stored(model) for name, model in MODELS.items()}
    for name, kept in found.items():
        model = MODELS[name]
        rows = {"source": model.url, **_licence(model), "git SHA-1 there": model.git_sha1}
        say(console, name)
        rows |= _rows(kept) if kept is not None else {"stored": f"nothing in {weights_dir()}"}
        for what, said in rows.items():
            say(console, f"  {what + ':':<17}{said}")
    print_json(as_json, {name: _record(MODELS[name], kept) for name, kept in found.items()})


@app.command(epilog="Example: tog weights fetch contact-graspnet --accept-licence")
def fetch(
    model: Annotated[str, typer.Argument(help=f"One of: {', '.join(MODELS)}.")],
    accept_licence: Annotated[
        bool, typer.Option("--accept-licence", help="You have read the licence and accept it.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Download again, and in place of other weights.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the licence of published weights and, once it is accepted, download them."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

    from tog_drake import weights

    chosen: Model = valid(model, MODELS, "model")
    console = console_for(as_json)
    for what, said in _licence(chosen).items():
        say(console, f"{what}: {said}")
    columns = BarColumn(), DownloadColumn(), TransferSpeedColumn()
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as bars:
        bar = bars.add_task("", total=None, visible=False)
        kept = weights.fetch(
            chosen,
            accept_licence=accept_licence,
            force=force,
            progress=lambda done, total: bars.update(
                bar, completed=done, total=total, visible=True
            ),
        )
    _tell(console, kept)
    say(console, f"what they say of a cloud that is built in: tog weights check {chosen.name}")
    print_json(as_json, _record(chosen, kept))


@app.command(epilog="Example: tog weights add model.pt")
def add(
    file: Annotated[Path, typer.Argument(help="What torch.save wrote of Contact-GraspNet.")],
    as_json: JsonOption = False,
) -> None:
    """Store a file of weights from this machine, in place of what is stored."""
    from tog_drake import weights

    console = console_for(as_json)
    kept = weights.add(CONTACT_GRASPNET, file)
    _tell(console, kept)
    say(console, "what they say of a cloud that is built in: tog weights check")
    print_json(as_json, _record(kept.model, kept))


@app.command(epilog="Example: tog weights check")
def check(
    model: Annotated[
        str, typer.Argument(help=f"One of: {', '.join(MODELS)}.")
    ] = CONTACT_GRASPNET.name,
    checkpoint: Annotated[
        Path | None, typer.Option(help="A file of weights, instead of the stored one.")
    ] = None,
    batch_norm: Annotated[
        str,
        typer.Option(
            help="Normalise by statistics of the training: running; or of this cloud: batch."
        ),
    ] = "running",
    as_json: JsonOption = False,
) -> None:
    """Load weights and ask the network about a box and a cylinder on a table.

    Exit 0: they load, and nothing tells that they were never trained; 1: something does, or the
    stored file has changed; 2: they do not load.
    """
    from tog_drake.proposers.contact_graspnet import require_torch
    from tog_drake.proposers.contact_graspnet.proposer import VALID
    from tog_drake.weights import stored, stored_file

    chosen: Model = valid(model, MODELS, "model")
    valid(batch_norm, dict.fromkeys(VALID["batch_norm"]), "--batch-norm")
    require_torch()
    from tog_drake.proposers.contact_graspnet.checkpoint import load_network
    from tog_drake.proposers.contact_graspnet.trial import (
        signs_of_no_training,
        try_out,
        untrained_network,
    )

    console = console_for(as_json)
    file = stored_file(chosen) if checkpoint is None else checkpoint
    network, loaded = load_network(file, device="cpu", batch_norm=batch_norm)
    said = try_out(network)
    untrained = try_out(untrained_network())
    problems = signs_of_no_training(loaded.state, said)
    kept = stored(chosen) if checkpoint is None else None
    if kept is not None and kept.changed:
        problems.append(f"the file is {CHANGED}")
    say(console, f"weights: {file}, {which(loaded.released)} (SHA-256 {loaded.sha256})")
    say(console, f"the network says: {said}")
    say(console, f"an untrained one: {untrained}")
    for problem in problems:
        say(console, f"PROBLEM: {problem}")
    content = {"file": str(file), "sha256": loaded.sha256, "released": loaded.released}
    trials = {"said": asdict(said), "untrained": asdict(untrained)}
    print_json(as_json, {**content, **trials, "problems": problems})
    raise typer.Exit(1 if problems else 0)


def _licence(model: Model) -> dict[str, str]:
    return {"licence": f"{model.licence}: {model.terms}", "its text": model.licence_text}


def _rows(kept: Stored) -> dict[str, str]:
    """What is said of stored weights."""
    return {
        "stored": f"{kept.file} ({kept.size / 1e6:.1f} MB), {kept.note}",
        "SHA-256": kept.sha256,
        "came from": kept.origin or "nobody knows where: there is no record of it",
    }


def _tell(console: "Console", kept: Stored) -> None:
    for what, said in _rows(kept).items():
        say(console, f"{what}: {said}")


def _record(model: Model, kept: Stored | None) -> dict[str, Any]:
    """What ``--json`` says of a model; ``stored`` is null where nothing is."""
    said: dict[str, Any] = {**asdict(model), "url": model.url, "stored": None}
    if kept is not None:
        said["stored"] = {
            "file": str(kept.file),
            "size": kept.size,
            "sha256": kept.sha256,
            "git_sha1": kept.git_sha1,
            "origin": kept.origin,
            "changed": kept.changed,
            "released": kept.released,
        }
    return said

"""The commands that offer something to other programs: ``tog serve ...``."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from tog_drake.errors import InputError
from tog_drake.options import ProposerOptions
from tog_drake.spread import spread
from tog_drake.terminal import console_for, print_weights, say

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig
    from tog_drake.proposers.serving import Propose

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Offer something to other programs."
)


@app.callback()
def _serve() -> None:
    """Or a single command would take the place of the group."""


@app.command(epilog="Example: tog serve proposer --proposer antipodal --port 8001")
@spread()
def proposer(
    *,
    options: ProposerOptions,
    scenario_text: Annotated[
        str | None,
        typer.Option(
            help="YAML with the proposer's settings, such as "
            "{pipeline: {proposer: !ContactGraspNet {regions: local}}}."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Where to listen; 0.0.0.0 is every network of this machine.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8001,
) -> None:
    """Propose grasps to `--proposer remote:URL` elsewhere, until Ctrl-C."""
    from tog_drake.pipeline import make_proposer
    from tog_drake.proposer import weights_of
    from tog_drake.proposers.answered import answerer_of
    from tog_drake.proposers.contact_graspnet.proposer import ContactGraspNet
    from tog_drake.proposers.serving import ProposerServer
    from tog_drake.record import kind_and_settings, proposer_name
    from tog_drake.scenario import Scenario, parse_scenario
    from tog_drake.urls import is_loopback

    console = console_for(as_json=False)
    config = parse_scenario(scenario_text or "{}", "--scenario-text", Scenario()).pipeline
    options.apply(config)
    made = make_proposer(config, seed=0)  # hears what is wrong before anybody asks
    name = proposer_name(kind_and_settings(config.proposer))
    weights = weights_of(made) if isinstance(config.proposer, ContactGraspNet) else None
    try:
        server = ProposerServer(
            (host, port),
            answerer_of(name, weights),
            proposals(config),
            lambda line: say(console, line),
        )
    except (OSError, UnicodeError, OverflowError) as error:
        raise InputError(
            f"cannot listen on {host}:{port} ({error}); valid: --host 127.0.0.1, another --port"
        ) from error
    print_weights(console, weights)
    say(console, f"proposer {name}: http://{host}:{server.server_port}/propose (Ctrl-C ends it)")
    if not is_loopback(f"http://{host}"):
        say(console, f"anybody who reaches {host} on the network can use it: it asks for no key")
    try:
        server.serve_forever()
    finally:
        server.server_close()


def proposals(config: "PipelineConfig") -> "Propose":
    """Makes grasps as a pipeline with this config does; the last proposer made is kept."""
    from tog_drake.pipeline import make_proposer
    from tog_drake.proposer import Proposer
    from tog_drake.proposers.propose_protocol import Request
    from tog_drake.values import Grasps, Workspace

    kept: tuple[Workspace, int, Proposer] | None = None

    def propose(request: Request) -> Grasps:
        nonlocal kept
        if kept is None or kept[:2] != (request.workspace, request.seed):
            of_request = replace(config, workspace=request.workspace)
            kept = (request.workspace, request.seed, make_proposer(of_request, request.seed))
        return kept[2].propose(request.cloud, request.view)

    return propose

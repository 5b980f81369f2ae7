"""What the record of an episode says of the questions to a vision-language model."""

from collections.abc import Iterable
from typing import Any, TypedDict

from tog_drake.decision import Decision
from tog_drake.errors import NoChoice, NoView
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.selectors.vlm.specification import specification
from tog_drake.values import Choice, Exchange

MAX_ANSWER = 20_000  # characters of an answer that a record keeps


class ExchangeRecord(TypedDict):
    """One question to a model and its answer; the images are in the report and on cassettes."""

    prompt: str  # name and version
    text: str  # with "[image 1]" and so on for the images
    marks: dict[str, int]  # label -> row among the feasible grasps
    key: str  # of the question on a cassette
    points: dict[str, list[float]]  # role -> [u, v] in the last image, wherever the answer points
    answer: str | None  # verbatim, cut after MAX_ANSWER characters; null: none came
    status: str
    message: str  # what is wrong with the answer
    model: str | None  # as the server named it
    seconds: float  # latency; of a replay, that of the recording; 0: not known
    tokens: dict[str, int] | None
    cost: float | None  # [USD]; null: the price is not known
    replayed: str | None  # the cassette that had the answer; null: it was asked for now


class VlmRecord(TypedDict):
    """What a model was asked in one decision, and what became of it."""

    strategy: str
    rendering: str
    model: str  # asked for, such as "gemini:NAME"; else the cassette, "replay:FILE"
    seed: int  # of the order and colours of the marks
    status: str | None  # of the choice; "ok": the answer was used; null: nothing was asked
    fallback: str | None  # the selector that chose because it could not be used
    exchanges: list[ExchangeRecord]


def exchanges_of(decision: Decision) -> tuple[Exchange, ...]:
    """Returns what a model was asked, of the view and then of the grasp, whatever came of it."""
    selected, said = decision.selected_view, decision.said
    exchanges = () if selected is None else selected.exchanges
    return exchanges + (said.exchanges if isinstance(said, Choice | NoView | NoChoice) else ())


def exchange_records(exchanges: Iterable[Exchange]) -> list[ExchangeRecord]:
    """Returns exchanges as a record keeps them, without their images."""
    return [
        ExchangeRecord(
            prompt=exchange.prompt,
            text=exchange.text,
            marks=dict(exchange.marks),
            key=exchange.key,
            points={role: list(point) for role, point in exchange.points.items()},
            answer=None if exchange.answer is None else exchange.answer[:MAX_ANSWER],
            status=exchange.status,
            message=exchange.message,
            model=exchange.model,
            seconds=round(exchange.seconds, 3),
            tokens=None if exchange.tokens is None else dict(exchange.tokens),
            cost=exchange.cost,
            replayed=exchange.replayed,
        )
        for exchange in exchanges
    ]


def vlm_record(decision: Decision, config: Any, *, seed: int) -> VlmRecord | None:
    """Returns the record of a decision by a model; None where another selector decided.

    Args:
        decision: it may have ended before anything was asked.
        config: of the selector.
        seed: that of the scenario.
    """
    if not isinstance(config, Vlm):
        return None
    said = decision.said
    return VlmRecord(
        strategy=config.strategy,
        rendering=config.rendering,
        model=f"replay:{config.replay}" if config.model is None else specification(config.model),
        seed=seed,
        status=said.status if isinstance(said, Choice | NoChoice) else None,
        fallback=said.fallback if isinstance(said, Choice) else None,
        exchanges=exchange_records(exchanges_of(decision)),
    )

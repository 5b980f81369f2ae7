"""Grasps from a server, which may be slow, broken or hostile; see ``propose_protocol``.

`tog serve proposer` is such a server. Nothing but the request is sent: no key, no cookie, nothing
from a .netrc. A redirect is not followed, an answer beyond 4 MB not read; what failed to connect is
tried once more. Whatever the server does, it is over after ``timeout``.
"""

import math
import time
from dataclasses import dataclass

from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoProposal, Unanswered
from tog_drake.http_post import post
from tog_drake.proposers.answered import AnsweredGrasps
from tog_drake.proposers.grasp_document import BadDocument, HoldNothing, grasps_in_world
from tog_drake.proposers.propose_protocol import Request, read_answer, request_body
from tog_drake.urls import host_of, is_plain_url
from tog_drake.values import View, Workspace

ATTEMPTS = 2
HINTS = {404: "; is the URL right (of `tog serve proposer` it ends in /propose)?"}


@dataclass
class Remote:
    """Grasps from a server: `!Remote {url: "http://gpu:8001/propose"}`."""

    url: str = "http://127.0.0.1:8001/propose"
    timeout: float = 60.0  # [s] for everything together
    images: bool = True  # whether depth and colours are sent besides the cloud


class RemoteProposer:
    """Proposes what a server answers (a ``Proposer``).

    Raises:
        InputError: the URL is none, or holds more than scheme, host and path.
    """

    def __init__(self, config: Remote, workspace: Workspace, seed: int):
        if not is_plain_url(config.url):
            # Not shown: it may hold a password, and messages end up in records.
            raise InputError(
                "the proposer's url is no URL of scheme, host and path alone; valid: one such as "
                "http://127.0.0.1:8001/propose"
            )
        if not 0 < config.timeout < math.inf:
            raise InputError(f"the proposer's timeout must be above 0 s, not {config.timeout:g}")
        self._config = config
        self._workspace = workspace
        self._seed = seed

    def propose(self, cloud: PointCloud, view: View) -> AnsweredGrasps:
        """Returns grasps, best first, possibly none.

        Raises:
            NoProposal: no server, no answer in time, or one that cannot be used.
        """
        config = self._config
        request = Request(cloud, view, self._workspace, self._seed)
        try:
            answer = post(
                config.url,
                {},
                request_body(request, images=config.images),
                deadline=time.monotonic() + config.timeout,
                attempts=ATTEMPTS,
                retryable=frozenset(),
                hints=HINTS,
            )
            document, answerer = read_answer(answer)
        except Unanswered as error:
            raise self._failed(str(error), error) from None
        except BadDocument as error:
            message = f"{host_of(config.url)} answers, but not with grasps: {error}"
            raise self._failed(message, Unanswered("unreadable", message)) from None
        try:
            grasps = grasps_in_world(document, cloud, view.X_WC)
        except HoldNothing as error:
            raise self._failed(str(error), Unanswered("unreadable", str(error))) from None
        return AnsweredGrasps(**vars(grasps), answerer=answerer)

    def _failed(self, what: str, error: Unanswered) -> NoProposal:
        advice = {
            "timed_out": f"; allow more than {self._config.timeout:g} s (timeout of !Remote)",
            "unreachable": ""
            if "does not speak" in what
            else "; `tog serve proposer` there starts one",
        }
        message = f"no grasps from {self._config.url}: {what}{advice.get(error.status, '')}"
        return NoProposal(message, error.status)

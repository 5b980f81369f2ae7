"""Views scored by a detection server, which may be slow, broken or hostile; see
``detect_protocol``.

Nothing but the pictures and the target's words is sent: no key, no cookie, nothing from a .netrc.
A redirect is not followed, an answer beyond 4 MB not read; what failed to connect is tried once
more. Whatever the server does, it is over after ``timeout``.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoView, Unanswered
from tog_drake.http_post import post
from tog_drake.urls import host_of, is_plain_url
from tog_drake.values import AnswerStatus, CameraView, Candidates
from tog_drake.view_scorers.detect_protocol import BadAnswer, read_answer, request_body
from tog_drake.view_scorers.detections import Detection, check_target, score_detections
from tog_drake.view_selection import Scores

ATTEMPTS = 2


@dataclass
class Remote:
    """Asks a detection server: `!Remote {url: "http://gpu:8002/detect"}`."""

    url: str = "http://127.0.0.1:8002/detect"
    timeout: float = 60.0  # [s] for all views together


class RemoteScorer:
    """Scores views by what a server finds in them (a ``ViewScorer``).

    Raises:
        InputError: the URL is none, or holds more than scheme, host and path; or the timeout is
            none.
    """

    def __init__(self, config: Remote):
        if not is_plain_url(config.url):
            # Not shown: it may hold a password, and messages end up in records.
            raise InputError(
                "the view scorer's url is no URL of scheme, host and path alone; valid: one such "
                "as http://127.0.0.1:8002/detect"
            )
        if not 0 < config.timeout < math.inf:
            raise InputError(f"the view scorer's timeout must be above 0 s, not {config.timeout:g}")
        self._config = config

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns the greatest confidence in each view, 0 where the target was not found.

        Raises:
            NoView: the target has no words; no server, no answer in time, or one that cannot be
                used.
        """
        check_target(target)
        deadline = time.monotonic() + self._config.timeout
        found = [self._ask(seen, target, deadline) for seen in views]
        return score_detections(
            views, found, target, f"The detector at {host_of(self._config.url)}"
        )

    def _ask(self, seen: CameraView, target: str, deadline: float) -> list[Detection]:
        url = self._config.url
        try:
            answer = post(
                url,
                {},
                request_body(seen.view.rgb, [target]),
                deadline=deadline,
                attempts=ATTEMPTS,
                retryable=frozenset(),
                hints={},
            )
            return read_answer(answer)
        except Unanswered as error:
            advice = ""
            if error.status == "timed_out":
                advice = f"; allow more than {self._config.timeout:g} s (timeout of !Remote)"
            raise self._failed(seen, f"{error}{advice}", error.status) from None
        except BadAnswer as error:
            what = f"{host_of(url)} answers, but not with boxes: {error}"
            raise self._failed(seen, what, "unreadable") from None

    def _failed(self, seen: CameraView, what: str, status: AnswerStatus) -> NoView:
        message = f"no boxes in the view of {seen.camera} from {self._config.url}: {what}"
        return NoView(message, status=status)

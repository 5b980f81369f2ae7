"""From cloud and view to grasps. How they are found is behind the ``Proposer`` protocol."""

from collections.abc import Mapping
from typing import Any, Protocol

from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.errors import NoGrasp
from tog_drake.values import Grasps, View


class Proposer(Protocol):
    """Proposes grasps on whatever a cloud shows. It knows neither the objects nor the task."""

    def propose(self, cloud: PointCloud, view: View) -> Grasps:
        """Returns grasps in W, best first, possibly none.

        Args:
            cloud: of the things on the table: in W, without table and robot, with normals towards
                the camera. Only what it shows is to be grasped.
            view: the image that the cloud was made of and where it was taken from, for proposers
                that want the points of the table too, or to work in the camera's frame.
        """
        ...


def weights_of(proposer: Proposer) -> Mapping[str, Any] | None:
    """Returns what a proposer says of the weights that it works with; None where it has none.

    It says so by an attribute ``weights``: at least ``file`` and ``note``, as text. They are those
    that were loaded, whatever the file has become since.
    """
    return getattr(proposer, "weights", None)


class GraspProposer(LeafSystem):
    """Proposes grasps on whatever the cloud shows.

    .. pydrake_system::

        name: GraspProposer
        input_ports:
        - cloud
        - view
        output_ports:
        - grasps

    ``grasps`` is computed once per ``cloud`` and ``view``.

    Raises:
        NoGrasp: the proposer found none.
    """

    def __init__(self, proposer: Proposer):
        super().__init__()
        self._proposer = proposer
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._view = self.DeclareAbstractInputPort("view", Value(View.empty()))
        self.DeclareAbstractOutputPort(
            "grasps",
            alloc=lambda: Value(Grasps.empty()),
            calc=self._CalcGrasps,
            prerequisites_of_calc={self._cloud.ticket(), self._view.ticket()},
        )

    def _CalcGrasps(self, context: Context, output: Value) -> None:
        cloud = self._cloud.Eval(context)
        grasps = self._proposer.propose(cloud, self._view.Eval(context))
        if len(grasps) == 0:
            raise NoGrasp(
                f"no grasp proposed on the {cloud.size()} points of the cloud: what is in view may "
                "be wider than the hand opens, lower than the fingertips reach, or walled in; "
                "move it, or look from elsewhere"
            )
        output.set_value(grasps)

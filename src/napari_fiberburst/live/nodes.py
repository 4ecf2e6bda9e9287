"""Nodes of a linear spline, and how the cores of a frame lie on them."""

from dataclasses import dataclass

from napari_fiberburst.live.pose import Pose

# Where points (x, y) from the middle of a frame lie in nodes: column = u + a x - b y, row = v + b x + a y.
Placed = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Nodes:
    """Where nodes are: number n of a row or column lies at n spacings, pixels.

    The outermost ring only mirrors what is inside, so that loops need not know of edges.

    Attributes
    ----------
    column, row : int
        Numbers of the first node.
    rows, columns : int
        How many.
    spacing : float
        From one to the next, pixels.
    """

    column: int
    row: int
    rows: int
    columns: int
    spacing: float

    @property
    def origin(self) -> complex:
        """Where the first node lies, x + i y in pixels."""
        return complex(self.column, self.row) * self.spacing

    def holds(self, low: complex, high: complex, margin: float) -> bool:
        """Return whether all nodes from one corner (x + i y) to the other are there, and so many pixels about them."""
        first, last = self.origin, self.origin + complex(self.columns - 1, self.rows - 1) * self.spacing
        return (
            first.real <= low.real - margin
            and first.imag <= low.imag - margin
            and high.real + margin <= last.real
            and high.imag + margin <= last.imag
        )

    def about(self, middle: complex) -> "Nodes":
        """Return as many nodes about another middle, pixels."""
        column = round(middle.real / self.spacing - (self.columns - 1) / 2)
        row = round(middle.imag / self.spacing - (self.rows - 1) / 2)
        return Nodes(column, row, self.rows, self.columns, self.spacing)

    def under(self, pose: Pose) -> Placed:
        """Return how a frame that lies so lies on these nodes."""
        place, turn = (pose.place - self.origin) / self.spacing, pose.turn / self.spacing
        return place.real, place.imag, turn.real, turn.imag

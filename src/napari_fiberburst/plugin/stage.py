"""Temporary images, alone in a viewer; what was shown before comes back."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from napari.components import ViewerModel
from napari.layers import Image, Layer

from napari_fiberburst.plugin import METADATA_KEY
from napari_fiberburst.plugin.layers import image_layer
from napari_fiberburst.plugin.sides import Side

# Of the images of a run, what a user may have changed, in the order in which it is taken over.
_LOOK = ("contrast_limits_range", "contrast_limits", "gamma", "interpolation2d")


class Stage:
    """Hides all layers of a viewer and shows others in their place, until it is cleared.

    Parameters
    ----------
    viewer : ViewerModel
        Whose layers.
    when_disturbed : callable
        Called when somebody else adds a layer meanwhile, or takes one away.
    make_way : callable
        Clears it; called when another one is set up in the same viewer.
    """

    # Those that are set, of all viewers. One that is set up over another would take what that has hidden for hidden.
    _set: ClassVar[list["Stage"]] = []

    def __init__(self, viewer: ViewerModel, when_disturbed: Callable[[], None], make_way: Callable[[], None]) -> None:
        self._viewer, self._when_disturbed, self._make_way = viewer, when_disturbed, make_way
        self._before: dict[Layer, bool] | None = None
        self._grid: dict[str, object] = {}
        self._shown: list[Layer] = []

    @property
    def is_set(self) -> bool:
        """Whether it shows something, or nothing in place of what was shown."""
        return self._before is not None

    def set_up(self) -> None:
        """Hide what is shown; another stage in this viewer is cleared first."""
        for other in [stage for stage in Stage._set if stage._viewer is self._viewer]:
            other._make_way()
        Stage._set.append(self)
        self._before = {layer: layer.visible for layer in self._viewer.layers}
        for layer in self._viewer.layers:
            layer.visible = False
        for event in self._events:
            event.connect(self._take_change)

    def show(self, layer: Layer, name: str) -> Layer:
        """Add a temporary layer, on top; what the user works on stays selected."""
        layer.name = name
        # Of a run, so that nobody takes it for a burst.
        layer.metadata = {METADATA_KEY: {"run": name}}
        self._shown.append(layer)
        chosen = set(self._viewer.layers.selection)
        self._viewer.layers.append(layer)
        self._viewer.layers.selection = chosen
        return layer

    def show_side(self, side: Side, letter: str, like: Sequence[Layer]) -> list[Layer]:
        """Add the image of one side, which looks like these layers."""
        parts = side.placement.parts(side.image, side.acquisition)
        return self.show_parts(parts, side, f"{letter}, {side.name}", like)

    def show_parts(
        self, parts: Sequence[tuple[str, Any, str]], side: Side, name: str, like: Sequence[Layer]
    ) -> list[Layer]:
        """Add a layer for each part of an image that lies where a side does, and looks like these layers."""
        shown = []
        for number, (kind, data, axes) in enumerate(parts):
            layer = image_layer(data, axes, side.placement, side.canvas, number)
            if number < len(like):
                _take_look(layer, like[number])
            shown.append(self.show(layer, f"{name}{kind.removeprefix('image')}"))
        return shown

    def side_by_side(self, layers_each: int) -> None:
        """Show the two sides in napari's grid: on top of the list those of the left one, below those of the right.

        The same field is in sight, in half the width.
        """
        grid = self._viewer.canvas.grid
        self._grid = {"enabled": grid.enabled, "stride": grid.stride, "shape": grid.shape}
        # A negative stride counts from the top of the list, where the temporary layers are.
        self._set_grid({"stride": -layers_each, "shape": (1, 2), "enabled": True})
        self._viewer.scene.camera.zoom /= 2

    def clear(self) -> None:
        """Take the temporary layers away, and show what was shown before. May be called more than once."""
        before, self._before = self._before, None
        shown, self._shown = self._shown, []
        if before is None:
            return
        self.abandon()
        for layer in shown:
            if layer in self._viewer.layers:
                self._viewer.layers.remove(layer)
        for layer, was_visible in before.items():
            layer.visible = was_visible
        if self._grid:
            grid, self._grid = self._grid, {}
            self._set_grid(grid)
            self._viewer.scene.camera.zoom *= 2

    def abandon(self) -> None:
        """Leave the viewer as it is, because its window is gone."""
        if self in Stage._set:
            Stage._set.remove(self)
        for event in self._events:
            event.disconnect(self._take_change)

    @property
    def _events(self) -> tuple[Any, Any]:
        return self._viewer.layers.events.inserted, self._viewer.layers.events.removed

    def _take_change(self, event: Any) -> None:
        if event.type == "removed" or event.value not in self._shown:
            self._when_disturbed()

    def _set_grid(self, values: Mapping[str, object]) -> None:
        for name, value in values.items():
            setattr(self._viewer.canvas.grid, name, value)


def _take_look(layer: Image, other: Layer) -> None:
    for attribute in _LOOK if layer.rgb else (*_LOOK, "colormap"):
        setattr(layer, attribute, getattr(other, attribute))

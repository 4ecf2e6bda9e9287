"""How the dock is laid out: sections that fold away, rows, and the way of the tab key."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from qtpy.QtCore import QEvent, QSize, Qt
from qtpy.QtGui import QIcon, QPixmap
from qtpy.QtWidgets import QFormLayout, QHBoxLayout, QLayout, QScrollArea, QVBoxLayout, QWidget
from superqt import QCollapsible

_ABOVE_CONTENT, _BELOW_CONTENT = 4, 10


class _Section(QCollapsible):
    """Grows with what is in it, also where that changes while it is open."""

    def eventFilter(self, watched: Any, event: Any) -> bool:
        if event.type() == QEvent.Type.LayoutRequest and self.isExpanded():
            self.content().setMaximumHeight(self.content().sizeHint().height() + _BELOW_CONTENT)
        return bool(super().eventFilter(watched, event))


class Column(QScrollArea):
    """Scrolls downwards alone, and is never narrower than what is in it: nothing is cut off.

    Parameters
    ----------
    content : QWidget
        What is in it.
    *hidden : QWidget
        What may be shown later in it, and has its room from the start: the column shall not widen under the pointer.
    """

    def __init__(self, content: QWidget, *hidden: QWidget) -> None:
        super().__init__()
        self._hidden = hidden
        self.setWidgetResizable(True)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setFrameShape(QScrollArea.Shape.NoFrame)
        self.setWidget(content)

    def minimumSizeHint(self) -> QSize:
        """Ask for the content's least width, and room for the scroll bar."""
        content, bar = self.widget(), self.verticalScrollBar()
        if content is None or bar is None:
            return super().minimumSizeHint()
        # The viewer's style gives even this one a frame.
        around = bar.sizeHint().width() + 2 * self.frameWidth()
        margins = content.contentsMargins() if (layout := content.layout()) is None else layout.contentsMargins()
        later = (widget.minimumSizeHint().width() + margins.left() + margins.right() for widget in self._hidden)
        width = max(content.minimumSizeHint().width(), *later, 0)
        return QSize(width + around, super().minimumSizeHint().height())

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Ask anew when what is in it has changed."""
        if event.type() == QEvent.Type.LayoutRequest:
            self.updateGeometry()
        return bool(super().eventFilter(watched, event))


def section(title: str, content: QWidget) -> QCollapsible:
    """Return a section around a widget, folded: it takes one line."""
    # superqt draws its own arrows once, in the colours that were there before the viewer's theme.
    folded, unfolded = f"▸  {title}", f"▾  {title}"
    made = _Section(folded, expandedIcon=_no_icon(), collapsedIcon=_no_icon())
    around = made.layout()
    if around is not None:
        around.setContentsMargins(0, 0, 0, 0)
        around.setSpacing(0)
    holder = QWidget()
    inside = QVBoxLayout(holder)
    inside.setContentsMargins(0, _ABOVE_CONTENT, 0, 0)
    inside.addWidget(content)
    made.setContent(holder)
    holder.installEventFilter(made)
    made.collapse(animate=False)
    holder.hide()  # superqt makes it flat, and the tab key would still go through what is in it

    def follow(is_open: bool) -> None:
        made.setText(unfolded if is_open else folded)
        holder.setVisible(is_open)

    made.toggled.connect(follow)
    return made


def _no_icon() -> QIcon:
    """Return an icon that shows nothing. An empty one will not do: under PySide6 it counts as none."""
    clear = QPixmap(1, 1)
    clear.fill(Qt.GlobalColor.transparent)
    return QIcon(clear)


def form_layout() -> QFormLayout:
    """Return a layout of labelled rows that fill the dock's width."""
    layout = QFormLayout()
    layout.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
    layout.setContentsMargins(0, 0, 0, 0)
    return layout


def row_of(*widgets: QWidget) -> QHBoxLayout:
    """Return widgets side by side."""
    row = QHBoxLayout()
    for widget in widgets:
        row.addWidget(widget)
    return row


def order_tabs(widget: QWidget) -> None:
    """Let the tab key go from control to control as they stand, and not as they were made."""
    stops = list(_stops(widget))
    for before, after in pairwise(stops):
        QWidget.setTabOrder(before, after)


def _stops(widget: QWidget) -> Iterator[QWidget]:
    """Yield what the tab key stops at in a widget, from top to bottom."""
    if widget.focusPolicy() & Qt.FocusPolicy.TabFocus:
        yield widget
        return
    layout = widget.layout()
    within = widget.widget() if isinstance(widget, QScrollArea) else None
    if layout is not None:
        yield from _stops_in(layout)
    elif within is not None:
        yield from _stops(within)


def _stops_in(layout: QLayout) -> Iterator[QWidget]:
    for number in range(layout.count()):
        item = layout.itemAt(number)
        widget, inner = (None, None) if item is None else (item.widget(), item.layout())
        if widget is not None:
            yield from _stops(widget)
        elif inner is not None:
            yield from _stops_in(inner)

"""What a user has set once for all: napari's preferences page, and the form as it was left."""

import json
from dataclasses import asdict, dataclass
from typing import Any

from napari.settings import get_plugin_settings
from qtpy.QtCore import QSettings

_PLUGIN = "napari-fiberburst"


@dataclass(frozen=True, kw_only=True)
class Preferences:
    """The preferences page, as `napari.yaml` declares it.

    Attributes
    ----------
    preset : str
        Where a new form starts from.
    device : str
        Where a new form computes.
    previews_per_second : float
        How often a running image is drawn at most.
    """

    preset: str = "auto"
    device: str = "auto"
    previews_per_second: float = 4.0


def preferences() -> Preferences:
    """Return the preferences; the defaults where napari does not know the plugin."""
    try:
        page = get_plugin_settings(_PLUGIN).reconstruction
    except KeyError:
        return Preferences()
    return Preferences(preset=page.preset, device=page.device, previews_per_second=page.previews_per_second)


def usual(wanted: Preferences) -> dict[str, Any]:
    """Return the choices of a form that nobody has touched."""
    preset = {} if wanted.preset == Preferences.preset else {"preset": wanted.preset}
    return preset | ({} if wanted.device == "auto" else {"device": wanted.device})


def remembered(wanted: Preferences) -> dict[str, Any]:
    """Return the form's choices as they were left; where the preferences have changed since, those they name."""
    try:
        stored = json.loads(str(_store().value("form", "")))
        return stored["choices"] if stored["preferences"] == asdict(wanted) else usual(wanted)
    except (ValueError, KeyError, TypeError):
        return usual(wanted)


def remember(choices: dict[str, Any], wanted: Preferences) -> None:
    """Keep the form's choices for the next time it is opened."""
    _store().setValue("form", json.dumps({"choices": choices, "preferences": asdict(wanted)}))


def _store() -> QSettings:
    return QSettings(QSettings.Format.IniFormat, QSettings.Scope.UserScope, _PLUGIN, "form")

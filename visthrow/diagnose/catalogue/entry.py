"""What an entry of the catalogue is: an effect, and what it changes in the description of a simulated flight."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from camera.params import CameraParams
from sim.params import PlantParams, SensingParams
from visthrow.common.errors import DiagnoseError, suggest
from visthrow.diagnose.models.interface import Effect

POSE = ("pos_w", "quat_wb")
PAYLOAD = ("payload_pos_w",)


@dataclass(frozen=True)
class Setting:
    """All that a replay simulates: the plant that training reads too, the sensors, and the step."""

    plant: PlantParams
    sensing: SensingParams = dataclasses.field(default_factory=SensingParams)
    step_square: float = 1.0  # of the integration step against the one asked for: errors grow with it
    camera: CameraParams | None = None  # whose keypoints the logs hold


@dataclass(frozen=True)
class Key:
    """A number of a :class:`Setting` that an effect changes."""

    path: str  # such as plant.vehicle.thrust.gain
    index: int | None = None  # of a tuple; None: all of it
    scale: bool = False  # times (1 + theta) instead of plus theta
    factor: float = 1.0  # of theta

    def changed(self, setting: Any, theta: float) -> Any:
        """The setting with this number changed."""
        names = self.path.split(".")
        value = setting
        for name in names:
            value = getattr(value, name)
        if isinstance(value, tuple):
            picked = range(len(value)) if self.index is None else (self.index,)
            new: Any = tuple(self._new(v, theta) if i in picked else v for i, v in enumerate(value))
        else:
            new = self._new(value, theta)
        return _replaced(setting, names, new)

    def _new(self, value: float, theta: float) -> float:
        return value * (1.0 + self.factor * theta) if self.scale else value + self.factor * theta


def _replaced(owner: Any, names: list[str], new: Any) -> Any:
    if len(names) == 1:
        return dataclasses.replace(owner, **{names[0]: new})
    return dataclasses.replace(owner, **{names[0]: _replaced(getattr(owner, names[0]), names[1:], new)})


@dataclass(frozen=True)
class Entry:
    """An effect and how it enters a setting."""

    effect: Effect
    keys: tuple[Key, ...]
    step: float = 0.25  # of theta for derivatives, in floors
    applies: Callable[[Setting], bool] = lambda setting: True
    switch: Callable[[Setting], Setting] | None = None  # to another kind of block, where theta is above a half
    simpler: bool = False  # a switch to a simpler block
    most: Callable[[Setting], float] | None = None  # negated, a bound: how far the setting's own value can go down

    def apply(self, setting: Setting, theta: float) -> Setting:
        """The setting in which the effect has the size ``theta``."""
        if self.switch is not None:
            return self.switch(setting) if theta > 0.5 else setting
        for key in self.keys:
            setting = key.changed(setting, theta)
        return setting

    def bounded(self, setting: Setting) -> "Entry":
        """The entry with the lower bound that this setting's own value sets: no negative mass, delay or drag."""
        if self.most is None:
            return self
        low = max(self.effect.bounds[0], -self.most(setting))
        return dataclasses.replace(self, effect=dataclasses.replace(self.effect, bounds=(low, self.effect.bounds[1])))


def entry(
    name: str, cause: str, equation: str, unit: str, block: str, bounds: tuple[float, float], prior_sd: float, floor: float,
    channels: tuple[str, ...], source: str, keys: Iterable[Key], *, confused: tuple[str, ...] = (),
    manoeuvres: tuple[str, ...] = (), **options: Any,
) -> Entry:  # fmt: skip
    """One line of a table of the catalogue."""
    effect = Effect(
        name, cause, equation, unit, block, bounds, prior_sd, floor, channels, source, confused, manoeuvres,
        switch=options.get("switch") is not None,
    )
    return Entry(effect, tuple(keys), **options)


def apply(entries: Mapping[str, Entry], setting: Setting, theta: Mapping[str, float]) -> Setting:
    """The setting with all these effects.

    Raises:
        DiagnoseError: no effect of that name.
    """
    for name, size in theta.items():
        if name not in entries:
            raise DiagnoseError(f"no effect '{name}'; {suggest(name, entries)}")
        if size != 0.0:
            setting = entries[name].apply(setting, size)
    return setting

"""Which schema each folder of configs, and each file that differs from its folder, is read with."""

import importlib

from visthrow.common.errors import ConfigError, suggest

SCHEMAS = {
    "vehicle": "sim.params:VehicleParams",
    "rope": "sim.params:RopeParams",
    "camera": "camera.params:CameraParams",
    "detector": "visthrow.detector_training.fit_detector:FitParams",
    "release": "sim.params:ReleaseParams",
    "sim": "sim.params:SimParams",
    "effects": "sim.effects.effect:EffectTables",
    "model_effects": "visthrow.diagnose.models.catalogue:ModelEffects",
    "task": "visthrow.task:TaskParams",
    "start": "sim.params:RandomizationParams",
    "train": "visthrow.task:Experiment",
    "cooperative": "visthrow.cooperative.team:TeamExperiment",
    "fleet": "sim.vehicle_class:FleetParams",
    "ppo": "visthrow.task:PPOParams",
    "sweep": "visthrow.paper.sweep:SweepList",
    "hil": "hil.params:HilParams",
    "diagnose": "visthrow.diagnose.inputs.setup:Setup",
    "vehicle/reference_realistic": "sim.reference.reference_extras:ReferenceExtras",
}
"""``kind`` or ``kind/name`` -> ``module:class``; the longer key wins."""


def schema_of(kind: str, name: str = "") -> type:
    """Return the schema of a config, whose module is imported only now; ConfigError for a kind of
    which none is known.
    """
    target = SCHEMAS.get(f"{kind}/{name}") or SCHEMAS.get(kind)
    if target is None:
        raise ConfigError(
            f"no kind of config '{kind}';"
            f" {suggest(kind, (key for key in SCHEMAS if '/' not in key))}"
        )
    module, attribute = target.split(":")
    return getattr(importlib.import_module(module), attribute)


def kinds_of(schema: type) -> list[str]:
    """Return the folders of configs whose files fill a schema: none for one that no shipped config
    has.
    """
    return [
        key
        for key, target in SCHEMAS.items()
        if target == f"{schema.__module__}:{schema.__name__}" and "/" not in key
    ]

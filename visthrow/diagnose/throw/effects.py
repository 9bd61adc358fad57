"""Which effects of the catalogue concern a plant and its logs."""

from sim.effects.effect import SettingEffect
from sim.effects.setting import Setting
from visthrow.config.effects import catalogue


def effects_for(
    setting: Setting, channels: set[str], payload: bool, releases: bool, simpler: bool = False
) -> dict[str, SettingEffect]:
    """Return effects that make sense in a setting and for logs with these channels, bounded by the setting's own values.

    ``simpler``: whether blocks simpler than the setting's are considered.
    """
    chosen = {}
    for name, e in catalogue().items():
        if e.simpler and not simpler:
            continue
        if e.block in ("rope", "rope mount", "payload", "payload air") and not payload:
            continue
        if (e.block in ("release", "ballistic") and not releases) or not e.applies(setting):
            continue
        if any(c in e.channels and c not in channels for c in ("rate_b", "keypoints", "landing")):
            continue
        if name.startswith(("payload_marker", "mocap_delay_payload")) and "payload_pos_w" not in channels:
            continue
        chosen[name] = e.bounded(setting)
    return chosen

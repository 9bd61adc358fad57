"""The catalogue: what reality may have and the simulator lacks. One table file a group of blocks.

The equation of an effect stands in the block of :mod:`sim` that it extends (or in :mod:`sim.replay.sensing`); an entry names the
numbers of the configuration that it changes, nothing more.
"""

from visthrow.diagnose.catalogue import air, body, camera, numerics, rope, sensing, structure, thrust
from visthrow.diagnose.catalogue.entry import Entry, Key, Setting, apply

ALL: dict[str, Entry] = {
    e.effect.name: e for table in (thrust, body, air, rope, sensing, camera, numerics, structure) for e in table.ENTRIES
}
"""Name -> entry."""


def entries_for(
    setting: Setting, channels: set[str], payload: bool, releases: bool, simpler: bool = False
) -> dict[str, Entry]:
    """Entries that make sense in a setting and for logs with these channels, with bounds from the setting's own values.

    Args:
        setting: what is diagnosed.
        channels: of the logs.
        payload: whether a payload is flown.
        releases: whether one is thrown.
        simpler: whether blocks simpler than the setting's are considered.
    """
    chosen = {}
    for name, e in ALL.items():
        about = e.effect.block
        if e.simpler and not simpler:
            continue
        if about in ("rope", "rope mount", "payload", "payload air") and not payload:
            continue
        if (about in ("release", "ballistic") and not releases) or not e.applies(setting):
            continue
        if any(c in e.effect.channels and c not in channels for c in ("rate_b", "keypoints", "landing")):
            continue
        if name.startswith(("payload_marker", "mocap_delay_payload")) and "payload_pos_w" not in channels:
            continue
        chosen[name] = e.bounded(setting)
    return chosen


__all__ = ["ALL", "Entry", "Key", "Setting", "apply", "entries_for"]

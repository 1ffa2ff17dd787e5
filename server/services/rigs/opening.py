"""Opens the rig that the service's settings name."""

from server.services.rigs.backend import RigBackend
from server.services.rigs.real import RealRig
from server.services.rigs.simulated import SimulatedRig
from server.settings import ServiceSettings


def open_rig(settings: ServiceSettings) -> RigBackend:
    """Returns the simulated studio, or the real rig if the settings name a rig.toml. No camera is opened yet. Raises
    InputError naming every fault of rig.toml."""
    calibration = settings.data / "rig" / "cameras.json"
    return SimulatedRig(calibration) if settings.rig is None else RealRig(settings.rig, calibration)

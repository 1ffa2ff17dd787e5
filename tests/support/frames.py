"""Takes single frames of camera drivers, as the feed takes the last of many."""

from rig.drivers.base import Driver, Frame


def grab_frame(driver: Driver, timeout_s: float) -> Frame:
    """Returns the next frame, decoded. Raises as ``grab`` and ``retrieve`` do."""
    arrival = driver.grab(timeout_s)
    return Frame(driver.retrieve(), arrival.time_s, arrival.sequence)

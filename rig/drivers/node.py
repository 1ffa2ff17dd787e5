"""Controls Raspberry Pi cameras that run deploy/raspberry_pi/node.py and send motion JPEG over HTTP.

In rig.toml, ``identity`` is the address of the Raspberry Pi, such as ``http://pi03.local:8080``.
"""

from urllib.parse import urlencode

from rig.drivers.base import CameraLost, Driver
from rig.drivers.opencv import MjpegDriver, connect
from rig.formats.rig_toml import CameraConfig
from rig.messages.message import Message, compose

_SETTINGS = ("trigger", "width", "height", "fps", "exposure_ms", "gain_db", "white_balance_k")
_TRIGGER_S = 1.0  # within which a node must take the command


def make(camera: CameraConfig, folder: object) -> Driver:
    """Creates the driver for a Raspberry Pi."""
    return NodeDriver(camera)


class NodeDriver(MjpegDriver):
    """Reads the stream of one Raspberry Pi."""

    def address(self) -> str:
        """Returns the stream's address, with the settings of rig.toml as query parameters."""
        wanted = {key: getattr(self._camera, key) for key in _SETTINGS if getattr(self._camera, key) is not None}
        return f"{self._root()}/stream?{urlencode(wanted)}"

    def configure(self) -> tuple[Message, ...]:
        """Returns one message for each setting that the camera refused."""
        unmet = self.header("X-Unmet").split(",")
        return tuple(
            compose("setting-refused", setting=key, value=str(getattr(self._camera, key))) for key in unmet if key
        )

    def trigger(self) -> None:
        """Makes the camera take a picture, if rig.toml sets a software trigger. Raises CameraLost."""
        if self._camera.trigger != "software":
            return
        try:
            with connect(f"{self._root()}/trigger", _TRIGGER_S, "POST") as connection:
                answer = connection.recv(64)
        except OSError as error:
            raise CameraLost(self._camera, compose("camera-does-not-release", reason=str(error))) from error
        if b" 204 " not in answer:
            reason = answer.decode("latin-1").partition("\r")[0]
            raise CameraLost(self._camera, compose("camera-does-not-release", reason=reason))

    def _root(self) -> str:
        return self._camera.identity.rstrip("/")

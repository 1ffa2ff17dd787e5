"""Stands in for picamera2 where there is no Raspberry Pi: a camera whose frames begin at whole periods, are stamped at
their readout as libcamera stamps them, and take long to encode. Its pictures are as bright as their exposure is long,
with one pixel that counts."""

import io
import math
import time
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np

PERIOD_NS, ENCODING_S = 50_000_000, 0.1


@dataclass(frozen=True, slots=True)
class Request:
    """Holds one frame."""

    begun_ns: int
    exposure_us: int
    size: tuple[int, int]

    def get_metadata(self) -> dict[str, int]:
        return {"SensorTimestamp": self.begun_ns + 1000 * self.exposure_us, "ExposureTime": self.exposure_us}

    def save(self, name: str, stream: io.BytesIO, format: str) -> None:
        time.sleep(ENCODING_S)
        image = np.full((self.size[1], self.size[0], 3), min(255, self.exposure_us // 100), np.uint8)
        image[:8, :8] = self.begun_ns // PERIOD_NS % 8 * 30
        stream.write(cv2.imencode("." + format, image)[1].tobytes())

    def release(self) -> None: ...


class Picamera2:
    sensor_resolution = (4056, 3040)
    camera_controls: ClassVar = {
        "ExposureTime": (110, 694_422_939, 20_000),
        "AnalogueGain": (1.0, 22.3, 1.0),
        "AeEnable": (False, True, True),
        "FrameDurationLimits": (19_989, 694_434_742, 33_333),
    }

    def __init__(self) -> None:
        self._size, self._exposure_us, self._runs = self.sensor_resolution, 20_000, False

    def create_video_configuration(self, main: dict[str, Any], controls: dict[str, Any]) -> dict[str, Any]:
        return {"main": main, "controls": controls}

    def configure(self, configuration: dict[str, Any]) -> None:
        if self._runs:
            raise RuntimeError("Camera must be stopped before configuring")
        width, height = configuration["main"]["size"]
        self._size = width - width % 2, height - height % 2
        self._exposure_us = configuration["controls"].get("ExposureTime", 20_000)

    def camera_configuration(self) -> dict[str, Any]:
        return {"main": {"size": self._size}}

    def start(self) -> None:
        self._runs = True

    def stop(self) -> None:
        self._runs = False

    def capture_request(self, flush: int) -> Request:
        begun_ns = math.ceil(flush / PERIOD_NS) * PERIOD_NS
        time.sleep(max(0.0, (begun_ns - time.monotonic_ns()) / 1e9 + self._exposure_us / 1e6))
        return Request(begun_ns, self._exposure_us, self._size)

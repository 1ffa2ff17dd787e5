"""Encodes and decodes text lines of the trigger box's protocol ``eigenhead-trigger/1`` (docs/rig.md)."""

from collections.abc import Iterator

PROTOCOL = "eigenhead-trigger/1"
BAUD = 115200
LINE_MOST = 80  # bytes between the start character and the newline; the firmware's buffer
REQUEST, REPLY = b"@", b"#"
DELAY_MOST_US = 500_000
PULSE_MOST_US = 500_000
WINDOW_MOST_MS = 60_000
CLOCK_PERIOD_US = 2**32  # the box counts microseconds in 32 bits: it wraps every 71.6 minutes


def crc16(data: bytes) -> int:
    """Computes the checksum CRC-16/CCITT-FALSE, with polynomial 0x1021 and start value 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        crc &= 0xFFFF
    return crc


def encode_line(start: bytes, sequence: int, body: str) -> bytes:
    """Encodes one line of the protocol. ``body`` must be printable ASCII without @, # and *."""
    payload = f"{sequence:02X} {body}".encode("ascii")
    return start + payload + f"*{crc16(payload):04X}\n".encode("ascii")


def decode_payload(line: bytes) -> tuple[int, str] | None:
    """Returns the sequence number and body of a line without start character and newline; None if it is damaged."""
    payload, star, digits = line.rpartition(b"*")
    if not star or len(payload) < 4 or payload[2:3] != b" " or not _is_hex(digits, 4) or not _is_hex(payload[:2], 2):
        return None
    if int(digits, 16) != crc16(payload) or not all(32 <= byte < 127 for byte in payload):
        return None
    return int(payload[:2], 16), payload[3:].decode("ascii")


class LineReader:
    """Splits a byte stream into valid lines that begin with ``start``, and counts damaged lines.

    ``stray`` holds the last 80 bytes outside lines, such as noise or the output of another device."""

    def __init__(self, start: bytes) -> None:
        self._start = start[0]
        self._line: bytearray | None = None
        self.stray = bytearray()
        self.bad_lines = 0

    def feed(self, data: bytes) -> Iterator[tuple[int, str]]:
        """Yields the sequence number and body of each valid line that ``data`` completes."""
        for byte in data:
            if byte == self._start:
                self.bad_lines += self._line is not None
                self._line = bytearray()
            elif self._line is None:
                self.stray = (self.stray + bytes([byte]))[-LINE_MOST:]
            elif byte == 0x0A:
                line, self._line = bytes(self._line), None
                decoded = decode_payload(line)
                if decoded is None:
                    self.bad_lines += 1
                    self.stray = (self.stray + line)[-LINE_MOST:]
                else:
                    yield decoded
            else:
                self._line.append(byte)
                if len(self._line) > LINE_MOST:
                    self.bad_lines += 1
                    self._line = None


def _is_hex(digits: bytes, count: int) -> bool:
    return len(digits) == count and all(digit in b"0123456789ABCDEF" for digit in digits)

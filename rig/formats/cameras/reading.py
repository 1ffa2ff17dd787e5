"""Collects what a reader of another program's cameras finds: faults, unused keys, cameras that take no part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from rig.errors import InputError
from rig.formats.cameras.cameras_json import FORMAT, rig_from_document
from rig.formats.cameras.foreign_keys import ForeignKey, Table, says_nothing
from rig.messages.message import Message, compose, say_once, some_of
from rig.rig import Rig

VALUE_MOST = 40  # characters of a value in a message


@dataclass(frozen=True, slots=True)
class CamerasRead:
    """Holds a rig, warnings of its reader, and the cameras of the file that take no part, each with the reason."""

    rig: Rig
    remarks: tuple[Message, ...] = ()
    left_out: Mapping[str, Message] = field(default_factory=dict)


@dataclass(slots=True)
class Reading:
    """Collects findings while the file named ``subject`` is read."""

    subject: str
    faults: list[Message] = field(default_factory=list)
    left_out: dict[str, Message] = field(default_factory=dict)
    _meant: dict[tuple[str, ForeignKey], list[tuple[str, object]]] = field(default_factory=dict)
    _unknown: dict[str, None] = field(default_factory=dict)

    def judge(self, table: Table, values: Mapping[str, object], whose: str, *, place: str = "") -> None:
        """Notes the keys of ``values`` that the table refuses, wants reported or does not contain.

        ``whose`` is the camera's name, empty for keys of the whole file; ``place`` is the prefix of the keys in the
        table."""
        for key, value in values.items():
            rule = table.get(place + key)
            if rule is None:
                self._unknown[place + key] = None
            elif rule.treatment in ("refused", "told") and value is not None and not says_nothing(value, rule):
                self._meant.setdefault((place + key, rule), []).append((whose, value))

    def leave_out(self, name: str, why: Message) -> None:
        """Notes that a camera takes no part, and why."""
        self.left_out[name] = why

    def finish(self, entries: Sequence[Mapping[str, object]]) -> CamerasRead:
        """Builds the rig from ``eigenhead-cameras/1`` entries and returns it with all notes. Raises InputError naming
        every fault."""
        warnings: list[Message] = []
        for (key, rule), cases in self._meant.items():
            whose, value = _whose([name for name, _ in cases], key), shown(cases[0][1])
            sentence = compose("key-is", whose=whose, value=value, why=rule.why)
            if rule.treatment == "refused":
                self.faults.append(sentence)
            else:
                warnings.append(
                    compose("unknown-key", remark=compose("key-not-used", file=self.subject, told=sentence))
                )
        if self._unknown:
            keys = some_of([shown(key) for key in self._unknown])
            remark = compose("keys-unknown", file=self.subject, count=len(self._unknown), keys=keys)
            warnings.append(compose("unknown-key", remark=remark))
        warnings += [compose("view-left-out", remark=sentence) for sentence in self._left_out()]
        names = [str(entry.get("name")) for entry in entries]
        try:
            rig = rig_from_document({"format": FORMAT, "unit": "mm", "cameras": list(entries)}, self.subject)
        except InputError as error:
            faults = [*self.faults, *error.faults]
            raise InputError(self.subject, [*say_once(faults, names), *self._left_out()]) from None
        if self.faults:
            raise InputError(self.subject, say_once(self.faults, names))
        return CamerasRead(rig, tuple(warnings), MappingProxyType(dict(self.left_out)))

    def _left_out(self) -> list[Message]:
        reasons: dict[Message, list[str]] = {}
        for name, why in self.left_out.items():
            reasons.setdefault(why, []).append(name)
        return [
            compose("cameras-left-out", cameras=some_of(names), why=why, file=self.subject)
            for why, names in reasons.items()
        ]


def shown(value: object, most: int = VALUE_MOST) -> str:
    """Returns a value as Python writes it, shortened to ``most`` characters inside its quotation marks."""
    if isinstance(value, str):
        return repr(value if len(value) <= most else value[: most - 3] + "...")
    text = repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def _whose(names: Sequence[str], key: str) -> str | Message:
    """Names a key together with the cameras that have it; a key of the whole file is named alone."""
    cameras = [name for name in names if name]
    if len(cameras) == 1:
        return key.replace("<name>", cameras[0]) if "<name>" in key else f"{cameras[0]}.{key}"
    return compose("key-of-cameras", cameras=len(cameras), names=some_of(cameras), key=key) if cameras else key

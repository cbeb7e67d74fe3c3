"""The root record of a store: which groups it is to hold, and whether it holds just these.

The root's attribute ``hyperpaint_set`` names every group with what it is made from (its inputs, or the token
of its content) and the digest of the settings. It is written before the first group of a run gets its place,
as an intention, and sealed after the last. Every group says its own path and settings among its sealed
attributes. A store of one group in its root has no such record: the group's own is all there is to say.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from shlex import quote
from typing import Any, NamedTuple

from hyperpaint.base.constants import NUMERICS_VERSION
from hyperpaint.base.errors import IncompleteStoreError, Problems, StoreError

from .budget import counted
from .groups import INPUTS
from .location import METADATA, Location
from .record import COMPLETE, PLACE, SEAL, SET, SETTINGS, metadata_checksum

_TEXT = re.compile(r"crc32c=([0-9a-f]{8}) (\{.*\})", re.DOTALL)
_NUMERICS = re.compile(r"numerics=(\d{1,9})\b")
_MOST_NAMED = 5
_FOLLOW = "hyperpaint.io.store.open_group(path, group) opens what is finished"


class Member(NamedTuple):
    """What a group of a store is."""

    identity: str  # Names what it is made from: the digest of its inputs, or the token of its content
    settings: str = ""  # Digest of the settings of the run that made it; none where a user wrote it


@dataclass(frozen=True)
class SetRecord:
    """The groups that a store is to hold."""

    groups: Mapping[str, Member] = field(default_factory=dict)  # By path
    finished: bool = False
    #: What stands for the one group that is being added (None) or replaced: the store is whole with it, too.
    before: Mapping[str, Member | None] = field(default_factory=dict)
    adopted: bool = False  # Groups were there before the store kept a record: some may have been lacking
    command: str = ""  # Finishes the run on the command line; ``{store}`` stands for the store's path

    @property
    def text(self) -> str:
        """The attribute's value."""
        document = {
            "adopted": self.adopted, "before": self.before, "command": self.command,
            "finished": self.finished, "groups": self.groups,
        }  # fmt: skip
        plain = json.dumps(document, sort_keys=True)
        return f"crc32c={metadata_checksum(json.loads(plain)):08x} {plain}"

    @classmethod
    def from_text(cls, text: str, where: str) -> SetRecord:
        """Return the record that an attribute holds; IncompleteStoreError where it holds none."""
        match = _TEXT.fullmatch(text)
        try:
            document: dict[str, Any] = json.loads(match[2]) if match else {}
            if match is None or metadata_checksum(document) != int(match[1], 16):
                raise ValueError("its checksum differs")
            groups = {str(path): Member(*map(str, entry)) for path, entry in document["groups"].items()}
            before = {
                str(path): None if entry is None else Member(*map(str, entry))
                for path, entry in document["before"].items()
            }
            return cls(
                groups,
                bool(document["finished"]),
                before,
                bool(document["adopted"]),
                str(document["command"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise IncompleteStoreError(
                f"the record of the groups of {where} is damaged ({error!s:.100})",
                mend="write it again with overwrite=True; groups that are whole stay",
                option="run its command again with --overwrite; groups that are whole stay",
            ) from None

    def allows(self, group: str, member: Member | None) -> bool:
        """Tell whether a group is what it is to be, or may still be while one group is replaced."""
        if group in self.before and member == self.before[group]:
            return True
        return member is not None and self.groups.get(group) == member


@dataclass(frozen=True)
class SetState:
    """How the groups of a store agree with its root record."""

    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    resume: str = ""  # What finishes it on the command line, where that is known


def read_set(location: Location) -> SetRecord | None:
    """Return the root record of a store; None without one, IncompleteStoreError where it is damaged."""
    text = _text(location)
    return None if text is None else SetRecord.from_text(text, location.url)


def set_stamp(location: Location) -> str | None:
    """Return what changes whenever a writer begins or ends."""
    try:
        return _text(location)
    except IncompleteStoreError as error:
        return str(error)


def _text(location: Location) -> str | None:
    if location.local is not None:  # elsewhere nothing says whether a file is still the same
        with contextlib.suppress(OSError):
            return _cached_text(location.url, location.fs.ukey(location.key("", METADATA)))
    return _text_of_root(location)


@functools.lru_cache(maxsize=32)
def _cached_text(url: str, state: str) -> str | None:  # noqa: ARG001  (the state of the file is a key)
    return _text_of_root(Location.of(url))


def _text_of_root(location: Location) -> str | None:
    attributes = (location.read_json("", METADATA) or {}).get("attributes") or {}
    return None if attributes.get(SET) is None else str(attributes[SET])


def member_of(node: Mapping[str, Any] | None) -> Member | None:
    """Return what a group is by its metadata; None where it was never finished."""
    attributes = (node or {}).get("attributes") or {}
    seal = SEAL.fullmatch(str(attributes.get(COMPLETE)))
    if seal is None:
        return None
    return Member(str(attributes.get(INPUTS) or seal[1]), str(attributes.get(SETTINGS, "")))


def numerics_of(settings: str) -> int | None:
    """Return the version of the numerics that settings name; None where they name none."""
    match = _NUMERICS.match(settings)
    return None if match is None else int(match[1])


def present_members(location: Location, groups: Iterable[str]) -> dict[str, Member]:
    """Return what the finished groups among ``groups`` are."""
    members = {}
    for group in groups:
        member = None if is_misplaced(node := _node(location, group), location, group) else member_of(node)
        if member is not None:
            members[group] = member
    return members


def _node(location: Location, group: str) -> dict[str, Any]:
    """Return a group's metadata; none where they cannot be read."""
    try:
        return location.metadata(group) or {}
    except StoreError:
        return {}


def is_misplaced(node: Mapping[str, Any], location: Location, group: str) -> bool:
    """Tell whether a group lies elsewhere than it was written: it was copied, renamed or swapped.

    A group may be opened by its own folder, or as the whole of a store that it was copied to.
    """
    place = (node.get("attributes") or {}).get(PLACE)
    return (
        bool(group)
        and place is not None
        and not f"{location.url}/{group}".replace("\\", "/").endswith(f"/{str(place).lstrip('/')}")
    )


# --- intended and present ----------------------------------------------------------------------------------


def set_state(location: Location, groups: Iterable[str] | None = None) -> SetState:
    """Compare the groups that a store is to hold with those that it holds (``groups``, where listed)."""
    present = location.groups() if groups is None else list(groups)
    nodes = {group: _node(location, group) for group in present}
    try:
        record = read_set(location)
    except IncompleteStoreError as error:
        return SetState((str(error),))
    if record is None:
        return _unrecorded(location, nodes)
    problems = [
        f"/{group}: foreign: the store's record does not name it; move it away, or write it with to_store"
        for group in nodes
        if group not in record.groups
    ]
    lacking: list[str] = []
    for group, wanted in record.groups.items():
        node = nodes.get(group)
        if node is not None and is_misplaced(node, location, group):
            place = node["attributes"][PLACE]
            problems.append(f"/{group}: swapped or copied: by its own record it is {place!s:.200}")
            continue
        member = member_of(node)
        if record.allows(group, member):
            continue
        if not (record.finished or record.before):
            lacking.append(group)
        elif node is None:
            problems.append(
                f"/{group}: deleted: the store's record names it, but it is not there; write it again, or "
                "anything else with overwrite, which forgets it"
            )
        elif member is None:
            continue  # its own record, or the lack of one, says so
        elif member.settings != wanted.settings:
            problems.append(f"/{group}: mixed settings: made with others than the store's record names")
        else:
            problems.append(f"/{group}: foreign: other content than the store's record names")
    notes = (*([_ADOPTED.format(location.url)] if record.adopted else []), *_older(record))
    if record.finished or (record.before and nodes):
        return SetState(tuple(problems), notes)
    resume = record.command.replace("{store}", quote(location.url))
    return SetState((_unfinished(record, lacking, resume), *problems), notes, resume)


def _older(record: SetRecord) -> Iterator[str]:
    """Yield that groups were made by another version of the numerics."""
    versions = {numerics_of(member.settings) for member in record.groups.values()} - {None, NUMERICS_VERSION}
    for version in sorted(filter(None, versions)):
        yield f"made by numerics {version}, this is {NUMERICS_VERSION}: --overwrite computes it again"


def _unfinished(record: SetRecord, lacking: list[str], resume: str) -> str:
    there = f"{len(record.groups) - len(lacking)} of {counted(len(record.groups), 'group')} are there"
    more = f" and {len(lacking) - _MOST_NAMED} more" if len(lacking) > _MOST_NAMED else ""
    names = ", ".join(f"/{group}" for group in lacking[:_MOST_NAMED])
    lacks = f"; lacking, or of other settings: {names}{more}" if lacking else ", but it was not sealed"
    again = f"to finish it: {resume}" if resume else "to finish it, write it again as it was begun"
    return f"unfinished: {there}{lacks}; {again}"


def _unrecorded(location: Location, nodes: Mapping[str, dict[str, Any]]) -> SetState:
    """Return what can be said of a store without a root record."""
    ours = {
        group: node for group, node in nodes.items() if group and COMPLETE in (node.get("attributes") or {})
    }
    recent = [group for group, node in ours.items() if _is_recent(node, group)]
    if recent:
        return SetState((_RECORD_GONE.format(location.url),))
    return SetState((), (_OLD.format(location.url),) if ours else ())


def _is_recent(node: Mapping[str, Any], group: str) -> bool:
    """Tell whether a group was written in its place by a version that keeps a root record."""
    return (node.get("attributes") or {}).get(PLACE) == f"/{group}"


_RECORD_GONE = (
    "{} has lost the record of the groups that it is to hold: another program rewrote its root; write it "
    "again by the command that made it, groups that are whole stay"
)
_OLD = (
    "{} was written by hyperpaint 0.1, which kept no record of the groups that it is to hold: each is "
    "checked, whether one is lacking is not known"
)

_ADOPTED = (
    "{} held groups before the record of what it is to hold was begun, by hyperpaint 0.1 or after its root "
    "was lost; whether one was lacking then is not known"
)


def check_set(location: Location, groups: Iterable[str] | None = None) -> tuple[str, ...]:
    """Refuse a store whose groups are not those that it is to hold; return notes on it."""
    state = set_state(location, groups)
    problems = Problems(f"{location.url} is not whole; {_FOLLOW}", IncompleteStoreError)
    for text in state.problems:
        problems.add(text)
    problems.raise_if_any()
    return () if any(state.notes) and read_set(location) else state.notes


def check_member(location: Location, group: str, node: Mapping[str, Any]) -> tuple[str, ...]:
    """Refuse a group that is not of its store, or whose store is unfinished; return notes on it.

    The store's other groups are not looked at, unless it is unfinished: then the error says which are
    lacking.
    """
    record = read_set(location)
    if record is None:
        if not group or COMPLETE not in (node.get("attributes") or {}):
            return ()
        if _is_recent(node, group):
            raise IncompleteStoreError(_RECORD_GONE.format(location.url), mend=_FOLLOW)
        return () if PLACE in node["attributes"] else (_OLD.format(location.url),)
    member = member_of(node)
    if (record.finished or record.before) and (member is None or record.allows(group, member)):
        return ()  # of one that was never finished its own record says so
    check_set(location)
    raise IncompleteStoreError(
        f"/{group} of {location.url} is not what the store's record names, or was never finished",
        mend="write it again",
    )


# --- what a writer intends ---------------------------------------------------------------------------------


class Intention(NamedTuple):
    """What a writer begins with."""

    record: SetRecord
    needed: tuple[str, ...]  # Groups that must be there for the record to be sealed

    def sealed(self, location: Location) -> SetRecord:
        """Return the record as it stands at the end: finished, unless groups of another run are lacking."""
        present = present_members(location, self.needed)
        finished = all(present.get(name) == self.record.groups[name] for name in self.needed)
        return replace(self.record, finished=finished, before={})


def intention(
    location: Location,
    wanted: Mapping[str, Member],
    pending: Iterable[str],
    *,
    command: str | None = None,
    overwrite: bool = False,
) -> Intention:
    """Return the record with which a writer begins: what was to be there, and ``wanted``.

    One group that a user adds to a whole store, or replaces (no ``command``), leaves it whole at every
    instant. With ``overwrite``, groups of others that are gone, or a damaged record, are forgotten.

    Raises `IncompleteStoreError`: the record is damaged, and must not be overwritten.
    """
    present = present_members(location, location.groups())
    old = _settled(location, present, overwrite=overwrite, again=command is not None)
    begun = [name for name in pending if name in wanted]
    alone = command is None and old.finished and len(begun) == 1
    return Intention(
        replace(
            old,
            groups={**old.groups, **wanted},
            finished=False,
            before={name: old.groups.get(name) for name in begun} if alone else {},
            adopted=old.adopted and any(name not in wanted for name in old.groups if name),
            command=old.command if command is None else command,
        ),
        tuple(wanted) if old.finished else (*old.groups, *wanted),
    )


def _settled(location: Location, present: Mapping[str, Member], *, overwrite: bool, again: bool) -> SetRecord:
    """Return the record from which a writer goes on; ``again``: it writes a whole run."""
    try:
        old = read_set(location)
    except IncompleteStoreError:
        if not overwrite:
            raise
        old = None
    if old is None:
        lost = [name for name in present if name and _is_recent(_node(location, name), name)]
        if lost and not (overwrite or again):
            raise IncompleteStoreError(_RECORD_GONE.format(location.url))
        return SetRecord(present, finished=True, adopted=any(present))
    groups = dict(old.groups)
    for name in old.before:  # whoever was killed there had put its group in its place, or had not
        groups.pop(name)
        groups |= {name: present[name]} if name in present else {}
    finished = old.finished or bool(old.before)
    if (finished and overwrite) or (not finished and again):
        groups = {name: each for name, each in groups.items() if name in present}
        finished = True
    return replace(old, groups=groups, finished=finished, before={})

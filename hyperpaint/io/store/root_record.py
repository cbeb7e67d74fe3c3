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
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote, split
from typing import Any, NamedTuple

from hyperpaint.base.constants import NUMERICS_VERSION
from hyperpaint.base.errors import IncompleteStoreError, Problems, StoreError

from .budget import counted
from .groups import INPUTS
from .location import METADATA, Location
from .record import COMPLETE, PLACE, SEAL, SET, SETTINGS, metadata_checksum, read_record

_TEXT = re.compile(r"crc32c=([0-9a-f]{8}) (\{.*\})", re.DOTALL)
_NUMERICS = re.compile(r"numerics=(\d{1,9})\b")
_COMMAND = re.compile(r"hyperpaint (process|render|run) ")
_MOST_NAMED = 5
_MOST_PROBLEMS = 20
_MOST_SIGNS = 2000  # Of a problem; half of them a command's
_MEND_BY_GROUP = "hyperpaint.io.store.open_group(path, group) opens what is finished"


class Member(NamedTuple):
    """What a group of a store is."""

    identity: str  # Names what it is made from: the digest of its inputs, or the token of its content
    settings: str = ""  # Digest of the settings of the run that made it; none where a user wrote it


@dataclass(frozen=True)
class SetRecord:
    """The groups that a store is to hold."""

    groups: Mapping[str, Member] = field(default_factory=dict)  # By path
    finished: bool = False
    #: What groups that a user adds (None) or replaces in a whole store were: with all of these it is whole,
    #: and while it is one group, with either.
    before: Mapping[str, Member | None] = field(default_factory=dict)
    adopted: bool = False  # Groups were there before the store kept a record: some may have been lacking
    command: str = ""  # Of the last run on the command line; ``{store}`` stands for the store's path
    run: tuple[str, ...] = ()  # Groups of an unfinished run, which that command finishes

    @property
    def text(self) -> str:
        """The attribute's value."""
        document = {
            "adopted": self.adopted, "before": self.before, "command": self.command,
            "finished": self.finished, "groups": self.groups, "run": self.run,
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
            if not before.keys() <= groups.keys():
                raise ValueError("it replaces groups that it does not name")
            return cls(
                groups, bool(document["finished"]), before, bool(document["adopted"]),
                str(document["command"]), tuple(map(str, document.get("run", ()))),
            )  # fmt: skip
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise IncompleteStoreError(
                f"the record of the groups of {where} is damaged ({error!s:.100})",
                mend="write all its groups with overwrite=True, as a tree; those that are whole stay",
                option="run its command again with --overwrite; groups that are whole stay",
            ) from None

    def allows(self, group: str, member: Member | None) -> bool:
        """Tell whether a group is what it is to be, or still what it was before it is replaced."""
        return (member is not None and member == self.groups.get(group)) or (
            group in self.before and member == self.before[group]
        )

    def is_settled(self, members: Mapping[str, Member]) -> bool:
        """Tell whether no writer was interrupted halfway: what differs from the record was changed since."""
        return self.finished or (
            bool(self.before and members)
            and (len(self.before) == 1 or all(members.get(name) == old for name, old in self.before.items()))
        )


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
    text = location.root_attributes().get(SET)
    return None if text is None else str(text)


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


def present_members(
    location: Location, listed: Iterable[str], recorded: Iterable[str] = ()
) -> dict[str, Member]:
    """Return what the finished groups of a store are: of those with arrays, ``listed``, and of a record."""
    members = {
        group: member_of(node)
        for group, node in _nodes(location, listed, recorded).items()
        if not is_misplaced(node, location, group)
    }
    return {group: member for group, member in members.items() if member is not None}


def _nodes(location: Location, listed: Iterable[str], recorded: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the metadata of groups with arrays, ``listed``, and of those ``recorded`` that have none."""
    nodes = {group: _node(location, group) for group in listed}
    for group in recorded:
        if group not in nodes:
            with contextlib.suppress(StoreError):  # its arrays were deleted
                if read_record(location, group) is not None:
                    nodes[group] = _node(location, group)
    return nodes


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
    place = _place(node)
    return bool(group and place) and not _real_path(location, group).endswith(place)


def _place(node: Mapping[str, Any]) -> str:
    """Return the path of a group when it was written, with a slash before it; empty where it has none."""
    place = (node.get("attributes") or {}).get(PLACE)
    return "" if place is None else f"/{str(place).lstrip('/')}"


def _real_path(location: Location, group: str) -> str:
    """Return the whole path of a group, through whatever link the store was reached."""
    if location.local is None:
        return location.group_url(group)
    return Path(os.path.realpath(location.local / group)).as_posix()


def _enclosing(location: Location, group: str, node: Mapping[str, Any]) -> Location | None:
    """Return the store of a group that is reached by a folder within it; None where there is none."""
    place, path = _place(node), _real_path(location, group)
    root = path.removesuffix(place)
    if place in ("", "/", f"/{group}") or root in ("", path) or root.endswith(("/", ":")):
        return None
    store = Location.of(root)
    return store if store.has("", METADATA) else None


# --- intended and present ----------------------------------------------------------------------------------


def set_state(location: Location, groups: Iterable[str] | None = None) -> SetState:
    """Compare the groups that a store is to hold with those that it holds (``groups``, where listed)."""
    listed = location.groups() if groups is None else list(groups)
    try:
        record = read_set(location)
    except IncompleteStoreError as error:
        return SetState((str(error),))
    nodes = _nodes(location, listed, record.groups if record else ())
    if record is None:
        return _unrecorded(location, nodes)
    misplaced = {group for group, node in nodes.items() if is_misplaced(node, location, group)}
    members = {
        group: member
        for group, node in nodes.items()
        if group not in misplaced and (member := member_of(node)) is not None
    }
    settled = record.is_settled(members)
    problems = [
        f"/{group}: foreign: the store's record does not name it; move it away, or write it with to_store"
        for group in nodes
        if group not in record.groups
    ]
    lacking: list[str] = []
    mends = "write it again, " + (_MEND_BY_RUN if record.command else "") + _MEND_BY_NOTHING
    for group, wanted in record.groups.items():
        node, member = nodes.get(group), members.get(group)
        if group in misplaced:
            problems.append(
                f"/{group}: swapped or copied: by its own record it is {_place(nodes[group]):.200}"
            )
        elif member == wanted or (settled and record.allows(group, member)):
            continue
        elif not settled:
            lacking.append(group)
        elif node is None:
            problems.append(f"/{group}: deleted: the store's record names it, but it is not there; {mends}")
        elif member is None:
            continue  # its own record, or the lack of one, says so
        elif member.settings != wanted.settings:
            problems.append(f"/{group}: mixed settings: made with others than the store's record names")
        else:
            problems.append(f"/{group}: foreign: other content than the store's record names")
    notes = (*([_NOTE_ADOPTED.format(location.url)] if record.adopted else []), *_older(record))
    resume = ""
    if not settled:
        if set(lacking) <= set(record.run):
            resume = _shown_command(record.command).replace("{store}", quote(location.url))
        problems.insert(0, _unfinished(record, lacking, resume))
    return SetState(tuple(_bounded(problems)), notes, resume)


_MEND_BY_RUN = "run its command with --overwrite, which forgets what is gone, "
_MEND_BY_NOTHING = "or say that it is empty: to_store(xr.Dataset(), path, group)"


def _bounded(problems: list[str]) -> Iterator[str]:
    """Yield problems so that a terminal shows them: names of groups are those of whoever wrote the store."""
    for text in problems[:_MOST_PROBLEMS]:
        yield "".join(sign if sign.isprintable() else "\ufffd" for sign in text[:_MOST_SIGNS])
    if len(problems) > _MOST_PROBLEMS:
        yield f"{len(problems) - _MOST_PROBLEMS} more groups that are not what the store's record names"


def _shown_command(command: str) -> str:
    """Return a command that may be shown to be typed; empty where it is none of hyperpaint's."""
    return (
        command
        if len(command) <= _MOST_SIGNS // 2 and _COMMAND.match(command) and command.isprintable()
        else ""
    )


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
    """Return what can be said of a store, or a part of one, without a root record."""
    ours = {group: node for group, node in nodes.items() if COMPLETE in (node.get("attributes") or {})}
    for group, node in ours.items():
        if (store := _enclosing(location, group, node)) is not None:
            state = set_state(store)
            return replace(state, problems=tuple(f"of {store.url}: {text}" for text in state.problems))
    problems = [
        f"/{group}: swapped or copied: by its own record it is {_place(node):.200}"
        for group, node in ours.items()
        if is_misplaced(node, location, group)
    ]
    inside = {group: node for group, node in ours.items() if group}
    if any(_place(node) == f"/{group}" for group, node in inside.items()):
        problems.append(_RECORD_IS_GONE.format(location.url))
    notes = {_note(node).format(location.url): None for node in inside.values()} if not problems else {}
    return SetState(tuple(_bounded(problems)), tuple(notes))


def _note(node: Mapping[str, Any]) -> str:
    """Return what is to be said of a group without a root record."""
    return _NOTE_PART if _place(node) else _NOTE_WITHOUT_RECORD


_RECORD_IS_GONE = (
    "{} has lost the record of the groups that it is to hold: another program rewrote its root; write it "
    "again by the command that made it, groups that are whole stay"
)
_NOTE_PART = "{} is a part of a store, without its root: whether a group is lacking is not known"
_NOTE_WITHOUT_RECORD = (
    "{} was written by hyperpaint 0.1, which kept no record of the groups that it is to hold: each is "
    "checked, whether one is lacking is not known"
)

_NOTE_ADOPTED = (
    "{} held groups before the record of what it is to hold was begun, by hyperpaint 0.1 or after its root "
    "was lost; whether one was lacking then is not known"
)


def check_set(location: Location, groups: Iterable[str] | None = None) -> tuple[str, ...]:
    """Refuse a store whose groups are not those that it is to hold; return notes on it."""
    state = set_state(location, groups)
    problems = Problems(f"{location.url} is not whole; {_MEND_BY_GROUP}", IncompleteStoreError)
    for text in state.problems:
        problems.add(text)
    problems.raise_if_any()
    return state.notes


def check_member(location: Location, group: str, node: Mapping[str, Any]) -> tuple[str, ...]:
    """Refuse a group that is not of its store, or whose store is unfinished; return notes on it.

    The store's other groups are not looked at, unless it is unfinished: then the error says which are
    lacking.
    """
    record, member = read_set(location), member_of(node)
    if record is None:
        if COMPLETE not in (node.get("attributes") or {}):
            return ()
        if (store := _enclosing(location, group, node)) is not None:
            return check_member(store, _place(node).lstrip("/"), node)
        if group and _place(node) == f"/{group}":
            raise IncompleteStoreError(_RECORD_IS_GONE.format(location.url), mend=_MEND_BY_GROUP)
        return (_note(node).format(location.url),) if group else ()
    untouched = record.finished or (record.before and (len(record.before) == 1 or group not in record.before))
    if untouched and (member is None or record.allows(group, member)):
        return ()  # of one that was never finished its own record says so
    notes = check_set(location)
    if record.allows(group, member):
        return notes
    raise IncompleteStoreError(
        f"/{group} of {location.url} is not what the store's record names, or was never finished",
        mend="write it again",
    )


# --- what a writer intends ---------------------------------------------------------------------------------


class Intention(NamedTuple):
    """What a writer begins with."""

    record: SetRecord
    needed: tuple[str, ...]  # Groups that must be there for the record to be sealed
    before: Mapping[str, Member | None]  # Of another writer, who was interrupted

    def sealed(self, location: Location) -> SetRecord:
        """Return the record as it stands at the end: finished, unless groups of another run are lacking."""
        present = present_members(location, (), self.needed)
        if all(present.get(name) == self.record.groups[name] for name in self.needed):
            return replace(self.record, finished=True, before={}, run=())
        return replace(self.record, before=self.before)


def intention(
    location: Location,
    wanted: Mapping[str, Member],
    pending: Iterable[str],
    *,
    command: str | None = None,
    overwrite: bool = False,
) -> Intention:
    """Return the record with which a writer begins: what was to be there, and ``wanted``.

    Groups that a user adds to a whole store, or replaces (no ``command``), leave its others as they are. A
    run of the store's command forgets what an unfinished run of it was to write, or with ``overwrite`` all
    that was deleted from a finished store. Whatever else is lacking stays so.

    Raises `IncompleteStoreError`: the record is damaged or lost, and not all of the store is written.
    """
    old = _recorded(location, wanted, command, overwrite=overwrite)
    present = present_members(location, location.groups(), old.groups)
    groups = dict(old.groups)
    finished = old.is_settled(present)
    if finished:  # whoever was interrupted had put the one group in its place, or had not
        for name, member in old.before.items():
            if present.get(name) != groups[name]:
                groups.pop(name)
                groups |= {} if member is None else {name: member}
    repeats = command is not None and _source(command) == _source(old.command)
    of_run = set(old.run if repeats else ())
    forgettable = groups if repeats and overwrite and finished else of_run
    groups = {name: each for name, each in groups.items() if name in present or name not in forgettable}
    others = [] if finished else [name for name in groups if name not in wanted and name not in of_run]
    lacking = any(present.get(name) != groups[name] for name in others)
    added = {name: groups.get(name) for name in pending if name in wanted}
    interrupted = {} if finished else old.before
    record = replace(
        old,
        groups={**groups, **wanted},
        finished=False,
        before={**added, **interrupted} if command is None and (finished or interrupted) else {},
        adopted=old.adopted and any(name not in wanted for name in old.groups if name),
    )
    if command is not None and (repeats or not lacking):  # else the other command must be run first
        record = replace(record, command=command, run=tuple(wanted))
    return Intention(record, (*wanted, *others), interrupted)


def _source(command: str) -> list[str]:
    """Return the words of a command that say what it makes a store of, its options left out."""
    try:
        return split(command)[:3]
    except ValueError:
        return [command]


def _recorded(
    location: Location, wanted: Mapping[str, Member], command: str | None, *, overwrite: bool
) -> SetRecord:
    """Return the record of a store; where it has none, one of what is there."""
    problem = None
    try:
        if (record := read_set(location)) is not None:
            return record
    except IncompleteStoreError as error:
        if not overwrite:
            raise
        problem = error
    present = present_members(location, location.groups())
    written = wanted if overwrite or command is not None else ()
    for name in present:
        if name in written or (not present[name].settings and (overwrite or command is not None)):
            continue  # a user's, which no run writes
        if problem is not None:
            raise problem
        if name and _place(_node(location, name)) == f"/{name}":
            raise IncompleteStoreError(_RECORD_IS_GONE.format(location.url))
    return SetRecord(present, finished=True, adopted=any(present))

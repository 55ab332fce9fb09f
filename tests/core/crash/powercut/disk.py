"""What a run does to the disk, and the states that POSIX allows a power cut to leave.

A `Recorder` stands in for `physx_core.files.os`: it does each operation in a real folder, and notes
it. A `Disk` plays the notes back, up to any of them, and builds the states of that moment:

- What was written to a file since its last sync is on the disk or not, each sector by itself, in
  any of the versions that it had since. Its size is any that it had since.
- Each change of names since the last sync of the folder has happened or not, by itself; a rename
  as a whole. A file whose name never reached the disk is gone, however often it was synced.
- What a failed sync was to write may never be written by a later one, unless it is written anew.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

SECTOR = 512
PAGE = 8 * SECTOR


class Killed(BaseException):
    """The process is dead: nothing that it does from now on has an effect."""


class Node:
    """A file or folder, whatever its names are.

    Attributes:
        label: Its first name, for messages.
        names: What a folder holds now, by name; None for a file.
        initial: What it held when recording began.
        current: What a file holds now.
    """

    __slots__ = ("current", "initial", "label", "names")

    def __init__(self, label: str, folder: bool = False) -> None:
        self.label = label
        self.names: dict[str, Node] | None = {} if folder else None
        self.initial: dict[str, Node] | bytes = {} if folder else b""
        self.current = bytearray()

    def __repr__(self) -> str:
        return self.label


Entry = tuple[Node, str, Node | None]
"""A folder, a name in it, and what has that name now."""


@dataclass(frozen=True, slots=True)
class Naming:
    """Names that change together."""

    entries: tuple[Entry, ...]

    def __str__(self) -> str:
        return ", ".join(f"{folder}/{name} -> {node}" for folder, name, node in self.entries)


@dataclass(frozen=True, slots=True)
class Write:
    """Bytes written to a file."""

    node: Node
    offset: int
    content: bytes

    def __str__(self) -> str:
        return f"write {len(self.content)} bytes at {self.offset} of {self.node}"


@dataclass(frozen=True, slots=True)
class Resize:
    """A new size of a file."""

    node: Node
    size: int

    def __str__(self) -> str:
        return f"resize {self.node} to {self.size}"


@dataclass(frozen=True, slots=True)
class Sync:
    """A sync of a file or folder, which may have failed."""

    node: Node
    failed: bool = False

    def __str__(self) -> str:
        return f"{'FAILED ' * self.failed}sync of {self.node}"


Operation = Naming | Write | Resize | Sync


class Recorder:
    """Does what the module `os` does, and notes what happens below one folder.

    What others write there is noticed when the file or its folder is next opened, synced or
    renamed.

    Attributes:
        root: The folder.
        top: Its node.
        journal: What has happened.
        before: Called before each operation with its name; may raise what the operation is to
            raise.
        actor: Who works now: `abandon` ends one actor.
    """

    def __init__(self, root: Path) -> None:
        self.root = os.path.abspath(root)
        self.journal: list[Operation] = []
        self.before: Callable[[str], None] = lambda name: None
        self.actor = 0
        self.top = Node(".", folder=True)
        self._dead = False
        self._open: dict[int, tuple[Node, tuple[int, int]]] = {}
        self._owned: dict[int, int] = {}
        self._scan(self.top, self.root)

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)

    # Ends of processes ----------------------------------------------------------------------

    def kill(self) -> None:
        """End the process: raise `Killed` now and for everything that it tries from now on."""
        self._dead = True
        raise Killed

    def bury(self, actor: int | None = None) -> None:
        """Close what the dead, or one actor, left open; another process may begin."""
        self._dead = False
        for descriptor, owner in list(self._owned.items()):
            if actor in (None, owner):
                del self._owned[descriptor]
                _, identity = self._open.pop(descriptor)
                if _identity(descriptor) == identity:
                    os.close(descriptor)

    # What changes the disk ------------------------------------------------------------------

    def open(self, path: str | Path, flags: int, mode: int = 0o777) -> int:
        """Open a file or folder, or create a file."""
        place = self._place(path)
        if place is None:
            return os.open(path, flags, mode)
        if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR):
            self._step("open")
        new = bool(flags & os.O_CREAT) and not os.path.lexists(path)
        descriptor = os.open(path, flags & ~os.O_TRUNC, mode)
        if new:
            folder, name = self._folder(place)
            self._note(Naming(((folder, name, Node(name)),)))
        node = self._find(place)
        if node is not None:
            self._open[descriptor] = node, _identity(descriptor)
            if flags & (os.O_WRONLY | os.O_RDWR):
                self._owned[descriptor] = self.actor
            if flags & os.O_TRUNC:
                self.ftruncate(descriptor, 0)
        return descriptor

    def close(self, descriptor: int) -> None:
        """Close a file."""
        if self._dead:
            raise Killed
        self._open.pop(descriptor, None)
        self._owned.pop(descriptor, None)
        os.close(descriptor)

    def dup(self, descriptor: int) -> int:
        """Return another descriptor of an open file."""
        if self._dead:
            raise Killed
        copy = os.dup(descriptor)
        if descriptor in self._open:
            self._open[copy] = self._open[descriptor]
            self._owned[copy] = self.actor
        return copy

    def pwrite(self, descriptor: int, content: bytes | memoryview, offset: int) -> int:
        """Write bytes."""
        node = self._begin("pwrite", descriptor)
        count = os.pwrite(descriptor, content, offset)
        if node is not None and count:
            self._note(Write(node, offset, bytes(content[:count])))
        return count

    def copy_file_range(
        self, origin: int, target: int, count: int, place: int | None, target_place: int
    ) -> int:
        """Copy bytes from one file to another."""
        node = self._begin("copy_file_range", target)
        done = os.copy_file_range(origin, target, count, place, target_place)
        if node is not None and done:
            copied = _content(target)[target_place : target_place + done]
            self._note(Write(node, target_place, copied))
        return done

    def ftruncate(self, descriptor: int, size: int) -> None:
        """Set a file's size."""
        node = self._begin("ftruncate", descriptor)
        before = os.fstat(descriptor).st_size
        os.ftruncate(descriptor, size)
        if node is not None and size != before:
            self._note(Resize(node, size))

    def posix_fallocate(self, descriptor: int, start: int, count: int) -> None:
        """Take space for a file, which may grow."""
        node = self._begin("posix_fallocate", descriptor)
        before = os.fstat(descriptor).st_size
        os.posix_fallocate(descriptor, start, count)
        if node is not None and start + count > before:
            self._note(Resize(node, start + count))

    def fsync(self, descriptor: int) -> None:
        """Sync a file or folder."""
        if self._dead:
            raise Killed
        node = self._open[descriptor][0] if descriptor in self._open else None
        if node is not None:
            self._notice(node, descriptor)
        try:
            self._step("fsync")
        except OSError:
            if node is not None:
                self._note(Sync(node, failed=True))
            raise
        if node is not None:
            self._note(Sync(node))

    fdatasync = fsync

    def mkdir(self, path: str | Path, mode: int = 0o777) -> None:
        """Make a folder."""
        self._step("mkdir")
        place = self._place(path)
        os.mkdir(path, mode)
        if place is not None:
            folder, name = self._folder(place)
            self._note(Naming(((folder, name, Node(name, folder=True)),)))

    def rmdir(self, path: str | Path) -> None:
        """Remove an empty folder."""
        self._remove("rmdir", os.rmdir, path)

    def unlink(self, path: str | Path) -> None:
        """Remove a name of a file."""
        self._remove("unlink", os.unlink, path)

    remove = unlink

    def link(self, path: str | Path, target: str | Path, **options: object) -> None:
        """Give a file another name."""
        self._step("link")
        node, place = self._known(path), self._place(target)
        os.link(path, target, **options)  # type: ignore[arg-type]
        if place is not None:
            self._note(Naming(((*self._folder(place), node),)))

    def replace(self, path: str | Path, target: str | Path) -> None:
        """Rename a file or folder."""
        self._step("rename")
        place, target_place = self._place(path), self._place(target)
        node = self._known(path)
        os.replace(path, target)
        if place is not None and target_place is not None:
            self._note(Naming(((*self._folder(place), None), (*self._folder(target_place), node))))

    rename = replace

    # What is noticed ------------------------------------------------------------------------

    def catch_up(self) -> None:
        """Notice what others have written by now."""
        self._scan(self.top, self.root, noted=True)

    def _scan(self, node: Node, path: str, noted: bool = False) -> None:
        """Bring a folder's node up to date; what is new is noted, or was there before."""
        assert node.names is not None
        found = sorted(os.scandir(path), key=lambda entry: entry.name)
        for name in sorted(node.names.keys() - {item.name for item in found}):
            self._note(Naming(((node, name, None),)))
        for item in found:
            known = node.names.get(item.name)
            if known is None:
                known = Node(item.name, folder=item.is_dir(follow_symlinks=False))
                if noted:
                    self._note(Naming(((node, item.name, known),)))
                else:
                    node.names[item.name] = node.initial[item.name] = known  # type: ignore[index]
                    if known.names is None:
                        known.initial = Path(item.path).read_bytes()
                        known.current = bytearray(known.initial)
            if known.names is not None:
                self._scan(known, item.path, noted)
            elif noted:
                descriptor = os.open(item.path, os.O_RDONLY)
                self._notice(known, descriptor)
                os.close(descriptor)

    def _notice(self, node: Node, descriptor: int) -> None:
        """Note what somebody else has written to a file."""
        if node.names is not None:
            return
        actual = _content(descriptor)
        known = node.current
        if len(actual) != len(known):
            self._note(Resize(node, len(actual)))
        for start in range(0, len(actual), PAGE):
            if actual[start : start + PAGE] != known[start : start + PAGE]:
                self._note(Write(node, start, actual[start : start + PAGE]))

    # Internals ------------------------------------------------------------------------------

    def _step(self, name: str) -> None:
        if self._dead:
            raise Killed
        self.before(name)

    def _begin(self, name: str, descriptor: int) -> Node | None:
        self._step(name)
        return self._open[descriptor][0] if descriptor in self._open else None

    def _note(self, operation: Operation) -> None:
        self.journal.append(operation)
        if isinstance(operation, Naming):
            for folder, name, node in operation.entries:
                assert folder.names is not None
                _assign(folder.names, name, node)
        elif isinstance(operation, Write):
            _put(operation.node.current, operation.offset, operation.content)
        elif isinstance(operation, Resize):
            _resize(operation.node.current, operation.size)

    def _remove(self, name: str, remove: Callable[[str | Path], None], path: str | Path) -> None:
        self._step(name)
        place = self._place(path)
        remove(path)
        if place is not None:
            folder, last = self._folder(place)
            self._note(Naming(((folder, last, None),)))

    def _place(self, path: str | Path) -> list[str] | None:
        """Return the names that lead to a path from the root; None if it is elsewhere."""
        full = os.path.abspath(path)
        if full == self.root:
            return []
        if not full.startswith(self.root + os.sep):
            return None
        return full[len(self.root) + 1 :].split(os.sep)

    def _folder(self, place: list[str]) -> tuple[Node, str]:
        folder = self._find(place[:-1])
        if folder is None:
            raise FileNotFoundError(errno.ENOENT, "nobody made this folder", str(place))
        return folder, place[-1]

    def _known(self, path: str | Path) -> Node | None:
        """Return the node of a path, with all that is below it brought up to date."""
        place = self._place(path)
        if place is None:
            return None
        node = self._find(place)
        if node is not None and node.names is not None:
            self._scan(node, str(path), noted=True)
        elif node is not None and os.path.lexists(path):
            descriptor = os.open(path, os.O_RDONLY)
            self._notice(node, descriptor)
            os.close(descriptor)
        return node

    def _find(self, place: list[str]) -> Node | None:
        node, path = self.top, self.root
        for name in place:
            path = os.path.join(path, name)
            assert node.names is not None
            if name not in node.names and os.path.lexists(path):  # somebody else made it
                made = Node(name, folder=os.path.isdir(path))
                self._note(Naming(((node, name, made),)))
            if name not in node.names:
                return None
            node = node.names[name]
        return node


def _identity(descriptor: int) -> tuple[int, int] | None:
    try:
        found = os.fstat(descriptor)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _content(descriptor: int) -> bytes:
    """Return what an open file holds, even if it is open for writing only."""
    with open(f"/proc/self/fd/{descriptor}", "rb") as file:
        return file.read()


def _assign(names: dict[str, Node], name: str, node: Node | None) -> None:
    if node is None:
        names.pop(name, None)
    else:
        names[name] = node


def _put(content: bytearray, offset: int, part: bytes) -> None:
    if len(content) < offset:
        _resize(content, offset)
    content[offset : offset + len(part)] = part


def _resize(content: bytearray, size: int) -> None:
    if size < len(content):
        del content[size:]
    else:
        content.extend(bytes(size - len(content)))


# The model --------------------------------------------------------------------------------------


Picks = dict[int, int]
"""Sector to number of its version: 0 is what is on the disk for certain."""


class FileState:
    """What may be on the disk of one file.

    Attributes:
        durable: What is there for certain, where nothing was written since.
        current: What was last written.
        versions: What each sector has held since then: operation and content, the oldest first.
        sizes: Sizes that the file has had: operation and size; the first is on the disk.
    """

    __slots__ = ("_doubtful", "_kept", "current", "durable", "sizes", "versions")

    def __init__(self, content: bytes = b"") -> None:
        self.durable = content
        self.current = bytearray(content)
        self.versions: dict[int, list[tuple[int, bytes]]] = {}
        self.sizes: list[tuple[int, int]] = [(-1, len(content))]
        self._doubtful: set[int] = set()
        self._kept: bytes | None = content

    @property
    def settled(self) -> bool:
        """Whether only one content is possible."""
        return not self.versions and len(self.sizes) == 1

    def write(self, moment: int, offset: int, content: bytes) -> None:
        """Write bytes."""
        before = len(self.current)
        _put(self.current, offset, content)
        if len(self.current) > before:
            self.sizes.append((moment, len(self.current)))
        self._renew(moment, offset, offset + len(content))

    def resize(self, moment: int, size: int) -> None:
        """Set the size."""
        before = len(self.current)
        _resize(self.current, size)
        self.sizes.append((moment, size))
        self._renew(moment, size, before)

    def sync(self, failed: bool) -> None:
        """Bring to the disk what was written; after a failed sync, nobody knows what was."""
        self._kept = None
        if failed:
            self._doubtful |= self.versions.keys()
            return
        before, self.durable = self.durable, bytes(self.current)
        if self._doubtful:
            picks = dict.fromkeys(self._doubtful, 0)
            self.durable = _patched(self.durable, ((s, _sector(before, s)) for s in picks))
        self.versions = {s: self.versions[s] for s in self._doubtful}
        self.sizes = [(-1, len(self.current))]

    def kept(self) -> bytes:
        """Return the content if everything is on the disk."""
        if self._kept is None:
            self._kept = bytes(self.current)
        return self._kept

    def content(self, picks: Picks, size: int) -> bytes:
        """Return one of the possible contents."""
        base = self.durable[:size].ljust(size, b"\0")
        chosen = ((s, self.versions[s][n - 1][1]) for s, n in picks.items() if n)
        return _patched(base, chosen)

    def until(self, moment: int) -> tuple[Picks, int]:
        """Return what the file held before an operation: the choice for `content`."""
        picks = {s: sum(at < moment for at, _ in found) for s, found in self.versions.items()}
        return picks, [size for at, size in self.sizes if at < moment][-1]

    def _renew(self, moment: int, start: int, stop: int) -> None:
        self._kept = None
        for sector in range(start // SECTOR, -(-stop // SECTOR)):
            self._doubtful.discard(sector)
            self.versions.setdefault(sector, []).append((moment, _sector(self.current, sector)))


def _sector(content: bytes | bytearray, sector: int) -> bytes:
    return bytes(content[sector * SECTOR : (sector + 1) * SECTOR]).ljust(SECTOR, b"\0")


def _patched(content: bytes, sectors: Iterable[tuple[int, bytes]]) -> bytes:
    changed, size = bytearray(content), len(content)
    for sector, part in sectors:
        start = sector * SECTOR
        if start < size:
            changed[start : start + SECTOR] = part[: size - start]
    return bytes(changed)


Tree = dict[str, bytes | None]
"""Path to content; None for a folder."""


@dataclass(frozen=True)
class Choice:
    """What of the pending changes is on the disk.

    Attributes:
        plan: How it was chosen, for messages.
        names: Numbers of the changes of names that have happened.
        files: Versions of sectors and size of each file with pending changes.
    """

    plan: str
    names: tuple[int, ...]
    files: dict[Node, tuple[Picks, int]] = field(default_factory=dict)


class Disk:
    """The states that a disk can be in after a cut at one moment of a recording.

    Attributes:
        moment: How many operations have begun; those of the journal before it.
    """

    def __init__(self, top: Node, journal: list[Operation]) -> None:
        self.moment = 0
        self._top, self._journal = top, journal
        self._files: dict[Node, FileState] = {}
        self._folders: dict[Node, dict[str, Node]] = {}
        self._pending: list[tuple[int, Naming]] = []
        self._full: dict[Node, tuple[Picks, int]] | None = None
        self._begin(top)

    def advance(self, moment: int) -> None:
        """Let operations happen, up to a moment."""
        for number in range(self.moment, moment):
            operation = self._journal[number]
            if isinstance(operation, Naming):
                self._name(number, operation)
            elif isinstance(operation, Write):
                self._files[operation.node].write(number, operation.offset, operation.content)
            elif isinstance(operation, Resize):
                self._files[operation.node].resize(number, operation.size)
            elif operation.node in self._files:
                self._files[operation.node].sync(operation.failed)
            elif not operation.failed:
                self._sync_folder(operation.node)
        self.moment, self._full = moment, None

    def build(self, choice: Choice) -> Tree:
        """Return what is on the disk after a choice."""
        folders = self._folders
        if choice.names:
            folders = {node: dict(names) for node, names in folders.items()}
            wanted = set(choice.names)
            for number, naming in self._pending:
                if number in wanted:
                    for folder, name, node in naming.entries:
                        _assign(folders[folder], name, node)
        tree: Tree = {}
        self._fill(tree, "", self._top, folders, choice)
        return tree

    # Choices --------------------------------------------------------------------------------

    def choices(self, chance: Callable[[int], random.Random]) -> Iterator[Choice]:
        """Yield choices without end: the extreme ones, then others by chance.

        Args:
            chance: Returns the source of chance of one of the choices by its number.
        """
        names = tuple(number for number, _ in self._pending)
        full = self._everything()
        yield Choice("everything is on the disk", names, full)
        yield Choice("nothing is on the disk", (), self._none())
        yield Choice("names without contents", names, self._none())
        yield Choice("names and sizes without contents", names, self._sizes_only())
        yield Choice("contents without names", (), full)
        number = 5
        while True:
            yield self._chosen(chance(number), names)
            number += 1

    def _chosen(self, chance: random.Random, names: tuple[int, ...]) -> Choice:
        how, which = chance.choice(_NAME_PLANS), chance.choice(_FILE_PLANS)
        dirty = list(self._everything())
        if not names:
            how = "all"
        if not dirty:
            which = "all"
        if which == "prefix":
            moment = chance.randint(0, self.moment)
            chosen = tuple(n for n in names if n < moment)
            return Choice(
                f"what happened before {moment}",
                chosen,
                {node: self._files[node].until(moment) for node in dirty},
            )
        plan = f"names: {how}, contents: {which}"
        return Choice(plan, _some_names(chance, how, names), self._some(chance, which, dirty))

    def _everything(self) -> dict[Node, tuple[Picks, int]]:
        """Choose what was written last of all files whose content is not certain."""
        if self._full is None:
            self._full = {
                node: state.until(self.moment)
                for node, state in self._files.items()
                if not state.settled
            }
        return self._full

    def _none(self) -> dict[Node, tuple[Picks, int]]:
        return {node: ({}, self._files[node].sizes[0][1]) for node in self._everything()}

    def _sizes_only(self) -> dict[Node, tuple[Picks, int]]:
        return {node: ({}, self._files[node].sizes[-1][1]) for node in self._everything()}

    def _some(
        self, chance: random.Random, which: str, dirty: list[Node]
    ) -> dict[Node, tuple[Picks, int]]:
        """Choose versions of all files."""
        full = self._everything()
        if which == "all":
            return full
        if which in ("one lost", "one kept"):
            one = chance.choice(dirty)
            size = chance.choice(self._files[one].sizes)[1]
            if which == "one lost":
                return full | {one: ({}, size)}
            return self._none() | {one: (full[one][0], size)}
        if which in ("sector lost", "sector kept"):
            one = chance.choice(dirty)
            versions = self._files[one].versions
            sector = chance.choice([*versions, -1])
            if which == "sector lost":
                picks = dict(full[one][0])
                picks.pop(sector, None)
                return full | {one: (picks, full[one][1])}
            picks = {sector: len(versions[sector])} if sector in versions else {}
            return self._sizes_only() | {one: (picks, full[one][1])}
        if which == "prefixes":
            return {node: self._files[node].until(chance.randint(0, self.moment)) for node in dirty}
        return {node: self._mixed(chance, which, self._files[node]) for node in dirty}

    def _mixed(self, chance: random.Random, which: str, state: FileState) -> tuple[Picks, int]:
        """Choose versions of one file: sectors or pages by themselves."""
        share = chance.choice((0.1, 0.5, 0.9))
        if which == "pages":
            pages = sorted({sector * SECTOR // PAGE for sector in state.versions})
            kept = {page for page in pages if chance.random() < share}
            picks = {s: len(v) for s, v in state.versions.items() if s * SECTOR // PAGE in kept}
        elif which == "sectors":
            picks = {s: len(v) for s, v in state.versions.items() if chance.random() < share}
        else:
            picks = {s: chance.randint(0, len(v)) for s, v in state.versions.items()}
        sizes = state.sizes
        return picks, (sizes[-1] if chance.random() < 0.7 else chance.choice(sizes))[1]

    # Internals ------------------------------------------------------------------------------

    def _begin(self, node: Node) -> None:
        if isinstance(node.initial, bytes):
            self._files[node] = FileState(node.initial)
        else:
            self._folders[node] = dict(node.initial)
            for below in node.initial.values():
                self._begin(below)

    def _name(self, number: int, naming: Naming) -> None:
        self._pending.append((number, naming))
        for _, _, node in naming.entries:
            if node is not None and node not in self._files and node not in self._folders:
                if node.names is None:
                    self._files[node] = FileState()
                else:
                    self._folders[node] = {}

    def _sync_folder(self, folder: Node) -> None:
        """Bring all changes of a folder's names to the disk, those of other folders with them."""
        rest = []
        for number, naming in self._pending:
            if all(entry[0] is not folder for entry in naming.entries):
                rest.append((number, naming))
                continue
            for where, name, node in naming.entries:
                _assign(self._folders[where], name, node)
                rest = [(n, _without(earlier, where, name)) for n, earlier in rest]
        self._pending = [(n, naming) for n, naming in rest if naming.entries]

    def _fill(
        self,
        tree: Tree,
        path: str,
        folder: Node,
        folders: dict[Node, dict[str, Node]],
        choice: Choice,
    ) -> None:
        for name, node in folders[folder].items():
            here = path + name
            if node in folders:
                tree[here] = None
                self._fill(tree, here + "/", node, folders, choice)
            elif node in choice.files:
                state, (picks, size) = self._files[node], choice.files[node]
                tree[here] = state.content(picks, size)
            else:
                tree[here] = self._files[node].kept()


def _without(naming: Naming, folder: Node, name: str) -> Naming:
    """Leave out what a later change has overwritten on the disk."""
    return Naming(tuple(e for e in naming.entries if (e[0], e[1]) != (folder, name)))


def _some_names(chance: random.Random, how: str, names: tuple[int, ...]) -> tuple[int, ...]:
    if how == "all":
        return names
    if how == "none":
        return ()
    if how == "one lost":
        lost = chance.choice(names)
        return tuple(n for n in names if n != lost)
    if how == "one kept":
        return (chance.choice(names),)
    return tuple(n for n in names if chance.random() < 0.5)


_NAME_PLANS = ("all", "all", "all", "none", "one lost", "one kept", "some")
_FILE_PLANS = (
    "all", "one lost", "one kept", "sector lost", "sector lost", "sector kept", "pages", "sectors",
    "versions", "prefixes", "prefix",
)  # fmt: skip


class Folder:
    """A real folder that takes one state after another; only what differs is written.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._now: Tree | None = None

    def become(self, tree: Tree) -> None:
        """Hold exactly these files."""
        if self._now is None:
            _clear(str(self.path))
            self._now = {}
        now, root = self._now, f"{self.path}/"
        for place in [
            place
            for place in now
            if place not in tree or (now[place] is None) != (tree[place] is None)
        ][::-1]:
            (os.unlink if now.pop(place) is not None else os.rmdir)(root + place)
        for place, content in tree.items():
            if place in now and now[place] == content:
                continue
            if content is None:
                os.mkdir(root + place)
            else:
                descriptor = os.open(root + place, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
                os.write(descriptor, content)
                os.close(descriptor)
            now[place] = content

    def touched(self) -> None:
        """Tell that somebody else has changed something."""
        self._now = None


def _clear(path: str) -> None:
    os.makedirs(path, exist_ok=True)
    for root, folders, names in os.walk(path, topdown=False):
        for name in names:
            os.unlink(os.path.join(root, name))
        for name in folders:
            os.rmdir(os.path.join(root, name))

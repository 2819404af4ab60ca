"""Recordings at addresses: bounds, recognised before they are copied, secrets, failing stores."""

import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evercal.errors import InputError, without_secrets
from evercal.features.encoder import load_encoder
from evercal.learning.task import LearnTask
from evercal.mapping.scene_map import MapContents
from evercal.recordings import addresses
from evercal.recordings.addresses import RecordingAt, local_copy
from evercal.recordings.load import format_of, load_recording

fsspec = pytest.importorskip("fsspec", reason="the extra 'ray' is not installed")
from fsspec.implementations.memory import MemoryFileSystem  # noqa: E402

ROOM = Path(load_recording.__code__.co_filename).parent / "sample_rooms" / "bedroom"


class Flaky(MemoryFileSystem):
    """A store whose connection breaks after some files, and stays broken."""

    protocol = "flaky"
    cachable = True
    store: dict[str, Any] = {}  # noqa: RUF012
    pseudo_dirs: list[str] = [""]  # noqa: RUF012
    last = 10**9
    fetched: list[str] = []  # noqa: RUF012
    dead = False

    @classmethod
    def _strip_protocol(cls, path: str) -> Any:
        return super()._strip_protocol(path.replace("flaky://", "/"))

    def _answer(self) -> None:
        if self.dead or len(Flaky.fetched) >= Flaky.last:
            self.dead = True
            raise ConnectionResetError("connection lost to user:SECRET")

    def get_file(self, *paths: Any, **options: Any) -> None:
        self._answer()
        Flaky.fetched.append(paths[0])
        super().get_file(*paths, **options)

    def put_file(self, *paths: Any, **options: Any) -> None:
        super().put_file(*paths, **options)
        self._answer()


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Copies go to a folder that is empty afterwards."""
    folder = tmp_path / "copies"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert not list(folder.iterdir())


@pytest.fixture
def flaky(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a room in a store that can break."""
    fsspec.register_implementation("flaky", Flaky, clobber=True)
    monkeypatch.setattr(Flaky, "fetched", [])
    monkeypatch.setattr(Flaky, "last", 10**9)
    store = fsspec.filesystem("flaky")
    store.put(str(ROOM), "/cell/bedroom", recursive=True)
    yield "flaky://cell/bedroom"
    Flaky.store.clear()
    Flaky.pseudo_dirs[:] = [""]
    Flaky.clear_instance_cache()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("ftp://user:pw@host:21/x: cut", "ftp://host:21/x: cut"),
        ("ftp://user:p/w@host/x", "ftp://host/x"),
        ("ftp://user:p@w@host/x", "ftp://host/x"),
        ("'sftp://me@host/x' (2)", "'sftp://host/x' (2)"),
        ("https://h/f.zip?sig=1:2: gone", "https://h/f.zip: gone"),
        ("zip://a::s3://k:v@b/c?x=1", "zip://a::s3://b/c"),
        ("zip://a?b=1::s3://c/d", "zip://a::s3://c/d"),
        ("http:/bob:pw@host/x?token=a: gone", "http:/host/x: gone"),
        ("http://host:80/a@b and a@b?", "http://host:80/a@b and a@b?"),
        ("s3://bucket/room@2", "s3://bucket/room@2"),
    ],
)
def test_messages_show_addresses_without_secrets(text: str, shown: str) -> None:
    assert without_secrets(text) == shown
    assert str(InputError(text)) == shown


def test_outcomes_and_names_hold_no_secrets() -> None:
    source = RecordingAt.of("nosuch://user:SECRET@host/room?key=SECRET")
    assert source.name == "room"
    error = LearnTask(MapContents(load_encoder(), 64)).done(0, source).error
    assert error.startswith("nosuch://host/room: cannot be read or written (ValueErr")
    assert "SECRET" not in error
    assert RecordingAt.of("ftp://user:SECRET@host").name == "host"


@pytest.mark.parametrize(
    "address",
    ["file://", "file:///", "memory://", "zip://", "s3:///"],
)
def test_an_address_without_a_path_is_refused(address: str) -> None:
    with pytest.raises(InputError, match="names no folder"), local_copy(address):
        pass


def test_a_recording_is_copied_and_read(flaky: str, tmp_path: Path) -> None:
    with local_copy(flaky, format_of) as copy:
        assert len(load_recording(copy).train) > 50
        first, last = Flaky.fetched[0], Flaky.fetched[-1]
    assert Path(first).suffix in (".json", ".csv", ".txt")
    assert Path(last).suffix == ".jpg"
    packed = tmp_path / "room.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for file in ROOM.rglob("*"):
            archive.write(file, file.relative_to(ROOM))
    with local_copy(f"zip://::file://{packed}", format_of) as copy:
        assert len(load_recording(copy).train) > 50


def test_a_copy_has_the_name_of_its_folder_and_all_names_before_their_bytes(
    flaky: str,
) -> None:
    looks = []

    def look(copy: Path) -> None:
        sizes = {file.suffix: file.stat().st_size for file in copy.rglob("*.*")}
        looks.append((copy.name, sizes[".jpg"] > 0, sizes[".json"] > 0))

    with local_copy(flaky, look) as copy:
        assert copy.name == "bedroom"
    assert looks == [("bedroom", False, True), ("bedroom", True, True)]


def test_a_listing_that_a_store_remembers_is_not_believed(
    flaky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    listings: dict[str, Any] = {}
    listed = MemoryFileSystem.ls

    def remembered(self: Flaky, path: str, detail: bool = True, **options: Any) -> Any:
        if path not in listings:
            listings[path] = listed(self, path, detail=detail, **options)
        return listings[path]

    def forget(self: Flaky, path: str | None = None) -> None:
        listings.clear()

    monkeypatch.setattr(Flaky, "ls", remembered)
    monkeypatch.setattr(Flaky, "invalidate_cache", forget)
    before = addresses.stamps(flaky)
    # Another machine writes.
    fsspec.filesystem("memory").pipe({"/x": b"1"})
    Flaky.store["/cell/bedroom/new.txt"] = MemoryFileSystem.store["/x"]
    after = addresses.stamps(flaky)
    assert {name for name, *_ in {*after} - {*before}} == {"/cell/bedroom/new.txt"}
    fsspec.filesystem("memory").rm("/x")


def test_what_is_no_recording_is_refused_before_it_is_copied(
    flaky: str, tmp_path: Path
) -> None:
    other = "flaky://cell/other"
    store = fsspec.filesystem("flaky")
    store.pipe({"/cell/other/a.bin": bytes(10**7), "/cell/other/b.txt": b"1"})
    no_format = r"^flaky://cell/other: no known scene format"
    with pytest.raises(InputError, match=no_format), local_copy(other, format_of):
        pass
    assert Flaky.fetched == ["/cell/other/b.txt"]
    # The same where many are learned.
    task = LearnTask(MapContents(load_encoder(), 64))
    error = task.done(0, RecordingAt.of(other)).error
    assert error.startswith("flaky://cell/other: no known scene format")
    assert len(Flaky.fetched) == 2
    with pytest.raises(InputError, match="flaky://cell/gone: no such folder or file"):
        addresses.stamps("flaky://cell/gone")


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("recording_files=10", "files at an address, at most 10 are read"),
        ("recording_bytes=1e5", "bytes at an address, at most 100,000 are read"),
    ],
)
def test_number_and_bytes_of_files_are_bounded_before_the_copy(
    flaky: str,
    limit: str,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("EVERCAL_LIMITS", limit)
    with pytest.raises(InputError, match=message), local_copy(flaky):
        pass
    assert not Flaky.fetched
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for i in range(20):
            archive.writestr(f"{i}.txt", bytes(10**5))
    bomb = f"zip://::file://{tmp_path}/bomb.zip"
    with pytest.raises(InputError, match=message), local_copy(bomb):
        pass
    if "bytes" in limit:
        one = f"file://{tmp_path}/large.mcap"
        (tmp_path / "large.mcap").write_bytes(bytes(10**6))
        with pytest.raises(InputError, match=message), local_copy(one):
            pass


def test_a_connection_that_breaks_leaves_nothing_and_the_next_try_works(
    flaky: str, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Flaky.last = 20
    message = r"^flaky://cell/bedroom: cannot be read or written \(ConnectionResetError"
    with pytest.raises(InputError, match=message), local_copy(flaky):
        pass
    assert len(Flaky.fetched) == 20
    assert not list(here.iterdir())
    file = tmp_path / "result.zip"
    file.write_bytes(b"1234")
    with pytest.raises(InputError, match=r"flaky://cell/kept/r.zip: cannot be read or"):
        addresses.put(file, "flaky://cell/kept/r.zip")
    Flaky.last = 10**9
    assert not addresses.exists("flaky://cell/kept/r.zip")
    addresses.put(file, "flaky://cell/kept/r.zip")
    with local_copy("flaky://cell/kept/r.zip") as copy:
        assert copy.read_bytes() == b"1234"
    with local_copy(flaky) as copy:
        assert load_recording(copy).name == "bedroom"
    monkeypatch.setattr(
        Flaky, "get_file", lambda _, rpath, lpath: Path(lpath).write_bytes(b"1")
    )
    with pytest.raises(InputError, match="ended early; try again"), local_copy(flaky):
        pass


def test_a_store_that_does_not_list_a_folder_is_an_error(
    flaky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files would be missing otherwise, without a word."""
    listing = Flaky.ls

    def broken(self: Flaky, path: str, detail: bool = True, **options: Any) -> Any:
        if path.endswith("images"):
            raise OSError("permission denied")
        return listing(self, path, detail=detail, **options)

    monkeypatch.setattr(Flaky, "ls", broken)
    with pytest.raises(InputError, match="permission denied"), local_copy(flaky):
        pass
    assert not Flaky.fetched


def test_a_server_of_s3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Credentials and the address of the server come from the profile of AWS."""
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    server = pytest.importorskip("moto.server", reason="moto[server] is not installed")
    running = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    (tmp_path / "config").write_text(
        f"[default]\nendpoint_url = http://{host}:{port}\n"
    )
    keys = "[default]\naws_access_key_id = a\naws_secret_access_key = b\n"
    (tmp_path / "credentials").write_text(keys)
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))
    try:
        store = fsspec.filesystem("s3")
        store.makedir("cell")
        store.put(str(ROOM), "cell/bedroom", recursive=True)
        with local_copy("s3://cell/bedroom", format_of) as copy:
            assert len(load_recording(copy).train) > 50
        assert not addresses.exists("s3://cell/kept/r.zip")
        addresses.put(ROOM / "scene.json", "s3://cell/kept/r.zip")
        assert addresses.exists("s3://cell/kept/r.zip")
    finally:
        running.stop()


@pytest.mark.parametrize("name", ["scene.json", "images/0.jpg"])
@pytest.mark.parametrize("kind", ["memory", "zip"])
def test_a_file_that_changes_has_another_stamp(
    kind: str, name: str, tmp_path: Path
) -> None:
    """Names, sizes and the address stay."""
    address = "memory://stamped"
    if kind == "zip":
        address = f"zip://room::file://{tmp_path}/a.zip"

    def stamped(content: bytes) -> list[tuple[str, ...]]:
        files = {"room/scene.json": b"1", "room/images/0.jpg": b"2"}
        files[f"room/{name}"] = content
        if kind == "zip":
            with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
                for file, data in files.items():
                    archive.writestr(zipfile.ZipInfo(file), data)
        else:
            store = fsspec.filesystem("memory")
            for file, data in files.items():
                store.pipe(f"/stamped/{file}", data)
        fsspec.get_filesystem_class(kind).clear_instance_cache()
        return addresses.stamps(address)

    first = stamped(b"a")
    assert first == addresses.stamps(address)
    if kind == "zip":
        assert first == stamped(b"a")
    assert first != stamped(b"b")

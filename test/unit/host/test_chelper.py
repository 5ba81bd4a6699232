"""Building the C helper: what Python knows of it comes from its headers, and both sides agree on every structure."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import chelper
from chelper.compiler import read_headers

ROOT = Path(__file__).resolve().parents[3]
HEADER = """
#include <stdint.h>
enum { ROOM = 3 };
struct opaque;
struct row { uint8_t kind; double places[ROOM]; };
static inline int twice(int a) { if (a) { return 2 * a; } return 0; }
double second_place(const struct row *row);
"""
SOURCE = """
#include "chelper/helper_api.h"
double second_place(const struct row *row) { return row->places[twice(1) / 2]; }
"""


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A helper of one header and one C file."""
    folder = tmp_path / "klippy" / "chelper"
    folder.mkdir(parents=True)
    (folder / "helper_api.h").write_text(HEADER)
    (folder / "row.c").write_text(SOURCE)
    monkeypatch.setattr(chelper, "HOST_DIR", tmp_path / "klippy")
    monkeypatch.setattr(chelper, "SOURCE_DIRS", (folder,))
    monkeypatch.setattr(chelper, "BUILD_DIR", tmp_path / "out")
    monkeypatch.setattr(chelper, "_loaded", None)
    return tmp_path


def test_declarations_come_from_the_header(tree: Path) -> None:
    ffi, lib = chelper.get_ffi()
    assert lib.second_place(ffi.new("struct row *", {"places": [1.0, 2.0, 3.0]})) == 2.0
    assert lib.ROOM == 3
    assert not hasattr(lib, "twice")


@pytest.mark.parametrize(
    ("header", "flags"),
    [
        ("#pragma pack(1)\n" + HEADER, ()),
        (
            HEADER.replace("double places", "\n#ifdef LONG_ROWS\nint64_t number;\n#endif\ndouble places"),
            ("-DLONG_ROWS",),
        ),
    ],
    ids=["packed", "compiled with another macro"],
)
def test_structure_that_c_deposits_out_otherwise_is_refused(
    tree: Path, monkeypatch: pytest.MonkeyPatch, header: str, flags: tuple[str, ...]
) -> None:
    (tree / "klippy" / "chelper" / "helper_api.h").write_text(header)
    monkeypatch.setattr(chelper, "COMPILE_FLAGS", (*chelper.COMPILE_FLAGS, *flags))
    with pytest.raises(chelper.HelperError, match="struct row"):
        chelper.get_ffi()


def test_changed_header_is_read_again(tree: Path) -> None:
    before = chelper.build()
    (tree / "klippy" / "chelper" / "helper_api.h").write_text(HEADER.replace("ROOM = 3", "ROOM = 4"))
    assert chelper.build() != before
    assert chelper.get_ffi()[1].ROOM == 4


def test_read_only_tree_is_built_in_the_users_cache(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tree / "cache"))
    (tree / "out").write_text("a file where the folder should be")
    library = chelper.build()
    assert library.is_relative_to(tree / "cache" / "ferrite")
    assert chelper.get_ffi()[1].ROOM == 3
    assert {path.suffix for path in library.parent.iterdir()} == {".so", ".py"}  # nothing half made


def test_missing_compiler_and_bad_source_are_reported_in_words(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(chelper.HelperError, match=r"'no-such-compiler'.*apt-get install gcc"):
        chelper.build()
    monkeypatch.delenv("CC")
    (tree / "klippy" / "chelper" / "row.c").write_text("int a = b;")
    with pytest.raises(chelper.HelperError, match=r"does not compile:\n.*row.c:1:"):
        chelper.build()
    assert list((tree / "out").iterdir()) == []


def test_start_of_a_host_neither_compiles_nor_parses() -> None:
    chelper.build()
    program = "import sys, chelper; chelper.get_ffi(); sys.exit('pycparser' in sys.modules)"
    environment = {"PYTHONPATH": str(ROOT / "klippy"), "CC": "no-such-compiler"}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


def test_headers_of_the_system_are_left_out(tmp_path: Path) -> None:
    header = tmp_path / "api.h"
    header.write_text(
        '#include <stdlib.h>\n#define EXPORT __attribute__((visibility("default")))\n'
        "EXPORT int run(void);\nextern const int count;\n"
    )
    assert read_headers([header]).split("\n")[-2:] == [" int run(void);", "extern int count;"]
    assert "malloc" not in read_headers([header])


def test_every_function_python_sees_is_in_the_library() -> None:
    """A declaration without a definition would fail only when somebody calls it."""
    _ffi, lib = chelper.get_ffi()
    for name in dir(lib):
        assert getattr(lib, name) is not None

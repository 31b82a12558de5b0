"""FMUs as they come: archives as other tools write them, folders that are not packed."""

from __future__ import annotations

import hashlib
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from master_node import Result, System, simulate
from master_node.system.files import export_system
from protocol.errors import ModelError
from protocol.host.archives import checked_archive
from protocol.host.files import Contents, as_file
from slave_node.agent.model_store import ModelStore
from slave_node.loading import describe_model, load_slave
from slave_node.validation.trials import Grade, validate
from tests.support.quarter_car_case import DISPLACEMENT


def unpacked(fmu: Path, folder: Path) -> Path:
    """The folder of an FMU."""
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder)
    return folder


def rewritten(fmu: Path, path: Path, rename: Callable[[str], str], *before: str) -> Path:
    """An archive with the same files under other names, behind entries of folders."""
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(path, "w") as target:
        for name in before:
            target.writestr(zipfile.ZipInfo(name), b"")
        for entry in source.infolist():
            target.writestr(rename(entry.filename), source.read(entry))
    return path


def car(chassis: Path, wheel: Path) -> System:
    """The quarter car."""
    return System(
        simulation={"stop_time": 0.2, "initial_step_size": 1e-3},
        slaves={"chassis": {"model": str(chassis)}, "wheel": {"model": str(wheel)}},
        connections=DISPLACEMENT,
    )


# ---- Archives -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rename", "before"),
    [
        (lambda name: name, ("./",)),
        (lambda name: f"./{name}", ("./", "./binaries/")),
        (lambda name: name.replace("/", "\\"), ("binaries\\",)),
        (lambda name: name.replace("/", "//"), ("./", "resources/", "resources\\")),
    ],
)
def test_entries_are_known_by_their_plain_names(
    fmu_dir: Path, tmp_path: Path, rename: Callable[[str], str], before: tuple[str, ...]
) -> None:
    """An entry of the root folder, ``./`` before each name, backslashes and double slashes: the
    FMU is loaded, and is the same one but for its hash.
    """
    path = rewritten(fmu_dir / "wheel.fmu", tmp_path / "wheel.fmu", rename, *before)
    plain = describe_model(str(fmu_dir / "wheel.fmu"), tmp_path)
    assert describe_model(str(path), tmp_path).variables == plain.variables
    (tmp_path / "scratch").mkdir()
    load_slave(str(path), tmp_path, "wheel", tmp_path / "scratch").close()


@pytest.mark.parametrize("name", ["", "./../a", "a/../../b", "/a", "\\a", "c:/a", "./c:/a"])
def test_entries_that_lead_outside_are_refused(tmp_path: Path, name: str) -> None:
    """However they are written, and before anything is extracted."""
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as archive:
        archive.writestr(zipfile.ZipInfo(name), b"a")
    with (
        pytest.raises(ModelError, match="leads outside the archive"),
        checked_archive(tmp_path / "a.fmu", "FMU"),
    ):
        pass


@pytest.mark.parametrize("names", [("a", "./a"), ("a/b", "a\\b"), ("a", "a/")])
def test_two_entries_of_one_plain_name_are_refused(tmp_path: Path, names: tuple[str, str]) -> None:
    """The one that is read must be the one that is extracted."""
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as archive:
        for name in names:
            archive.writestr(zipfile.ZipInfo(name), b"a")
    with (
        pytest.raises(ModelError, match="is there twice"),
        checked_archive(tmp_path / "a.fmu", "FMU"),
    ):
        pass


def test_a_folder_that_was_packed_as_a_whole_is_named(fmu_dir: Path, tmp_path: Path) -> None:
    """The message says where the model description is, and what to pack instead."""
    path = rewritten(fmu_dir / "wheel.fmu", tmp_path / "a.fmu", lambda name: f"wheel/{name}")
    with pytest.raises(ModelError) as caught:
        describe_model(str(path), tmp_path)
    assert "holds no modelDescription.xml at its root, but wheel/modelDescription.xml" in str(
        caught.value
    )
    assert caught.value.remedy == "pack what is in the folder wheel, and not the folder itself"


def test_a_binary_of_another_name_is_named(fmu_dir: Path, tmp_path: Path) -> None:
    """Both names are said; a binary for another platform only is told as before."""

    def load(old: str, new: str) -> str:
        path = rewritten(
            fmu_dir / "wheel.fmu", tmp_path / f"{len(new)}.fmu", lambda name: name.replace(old, new)
        )
        scratch = tmp_path / f"scratch-{len(new)}"
        scratch.mkdir()
        with pytest.raises(ModelError) as caught:
            load_slave(str(path), tmp_path, "wheel", scratch)
        return str(caught.value)

    (binary,) = (
        name
        for name in zipfile.ZipFile(fmu_dir / "wheel.fmu").namelist()
        if name.startswith("binaries/") and not name.endswith("/")
    )
    folder, _, file = binary.removeprefix("binaries/").partition("/")
    told = load(file, f"original{Path(file).suffix}")
    assert f"must be {binary}; it has original{Path(file).suffix}" in told
    assert "its modelIdentifier is 'wheel'" in told
    told = load(f"binaries/{folder}/", "binaries/other99/")
    assert f"has no binary for this platform, {folder}; it has other99" in told


def test_of_local_variables_of_one_name_the_first_has_it(fmu_dir: Path, tmp_path: Path) -> None:
    """It is a remark; a name that an input, an output or a parameter has is theirs; two of these
    are an error.
    """
    folder = unpacked(fmu_dir / "wheel.fmu", tmp_path / "wheel")
    description = folder / "modelDescription.xml"
    whole = description.read_text()

    def with_variables(*added: tuple[str, str]) -> None:
        more = "".join(
            f'<ScalarVariable name="{name}" valueReference="0" causality="{causality}"'
            + (' variability="fixed"' if causality == "parameter" else "")
            + '><Real start="7"/></ScalarVariable>'
            for name, causality in added
        ).replace('causality="local"><Real start="7"/>', 'causality="local"><Real/>')
        description.write_text(whole.replace("</ModelVariables>", f"{more}</ModelVariables>"))

    plain = describe_model(str(folder), tmp_path)
    with_variables(("twice", "local"), ("twice", "local"), ("x_c", "local"))
    found = describe_model(str(folder), tmp_path)
    assert [v.name for v in found.variables] == [*(v.name for v in plain.variables), "twice"]
    assert found.variable("x_c") == plain.variable("x_c")
    (told,) = (remark for remark in found.remarks if "several variables are called" in remark)
    assert "'twice'" in told
    assert "'x_c'" in told
    with_variables(("late", "local"), ("late", "parameter"))
    assert describe_model(str(folder), tmp_path).variable("late").start == 7.0
    with_variables(("x_c", "parameter"))
    with pytest.raises(ModelError, match="two variables are called 'x_c'"):
        describe_model(str(folder), tmp_path)


# ---- Folders ------------------------------------------------------------------------------------


def test_a_folder_runs_as_its_archive(fmu_dir: Path, tmp_path: Path, no_process_left: None) -> None:
    """In process and over the bus, with and without a slash behind its name: the same bits."""
    wheel = unpacked(fmu_dir / "wheel.fmu", tmp_path / "wheel")
    expected = simulate(car(fmu_dir / "chassis.fmu", fmu_dir / "wheel.fmu"), in_process=True)
    system = car(fmu_dir / "chassis.fmu", wheel)
    for result in (
        simulate(system, in_process=True),
        simulate(system.with_slave("wheel", model=f"{wheel}/"), output=tmp_path / "bus"),
    ):
        assert result.outputs.tobytes() == expected.outputs.tobytes()
    models = Result.load(tmp_path / "bus").summary["settings"]["models"]
    assert models["wheel"]["sha256"] == Contents.of(wheel).sha256


def test_a_folder_is_validated_and_has_a_name(fmu_dir: Path, tmp_path: Path) -> None:
    """Its description is checked as that of an archive."""
    unpacked(fmu_dir / "wheel.fmu", tmp_path / "wheel")
    findings = list(validate("wheel", tmp_path))
    assert findings[0].what == "model description"
    assert all(finding.grade is not Grade.PROBLEM for finding in findings)


def test_equal_folders_are_equal_archives(fmu_dir: Path, tmp_path: Path) -> None:
    """Times, permissions and the order on the disk leave no trace in the hash; contents do, and
    what does not belong to an FMU does not.
    """
    one = unpacked(fmu_dir / "wheel.fmu", tmp_path / "one")
    other = tmp_path / "other"
    for path in sorted(one.rglob("*"), reverse=True):
        if path.is_file():
            copy = other / path.relative_to(one)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            os.utime(copy, (1, 1))
            copy.chmod(0o600)
    (other / "results").mkdir()
    (other / "results" / "results.csv").write_text("time\n")
    contents = Contents.of(one)
    assert Contents.of(other) == contents
    with as_file(other) as packed:
        data = packed.read_bytes()
        assert Contents(hashlib.sha256(data).hexdigest(), len(data)) == contents
        assert describe_model(str(packed), tmp_path) == describe_model(str(one), tmp_path)
    (other / "resources").mkdir(exist_ok=True)
    (other / "resources" / "a").write_text("a")
    assert Contents.of(other) != contents


def test_a_folder_that_is_no_fmu_is_named(fmu_dir: Path, tmp_path: Path) -> None:
    """With the folder in it that is one."""
    unpacked(fmu_dir / "wheel.fmu", tmp_path / "models" / "wheel")
    with pytest.raises(ModelError, match=r"holds no modelDescription\.xml but wheel/") as caught:
        describe_model("models", tmp_path)
    assert caught.value.remedy == f"name the folder {tmp_path / 'models' / 'wheel'}"
    (tmp_path / "empty").mkdir()
    with pytest.raises(ModelError, match=r"empty: not an FMU: it holds no modelDescription\.xml$"):
        describe_model("empty", tmp_path)


def test_a_store_of_models_has_folders(fmu_dir: Path, tmp_path: Path) -> None:
    """Under the hash of the archive, which changes with any of their files."""
    wheel = unpacked(fmu_dir / "wheel.fmu", tmp_path / "wheel")
    (tmp_path / "nothing").mkdir()
    store = ModelStore(tmp_path)
    (model,) = store.models()
    assert (model.name, model.sha256, model.size) == ("wheel", *Contents.of(wheel))
    assert store.has("wheel")
    (wheel / "resources").mkdir(exist_ok=True)
    (wheel / "resources" / "new").write_text("1")
    assert store.name_of(model.sha256) is None
    assert store.name_of(Contents.of(wheel).sha256) == "wheel"


def test_a_folder_is_put_into_a_package(fmu_dir: Path, tmp_path: Path) -> None:
    """Packed, under the hash that the folder has."""
    wheel = unpacked(fmu_dir / "wheel.fmu", tmp_path / "wheel")
    file = tmp_path / "car.toml"
    file.write_text(
        f'[simulation]\nstop_time = 0.1\n[slaves.wheel]\nmodel = "{wheel.name}"\n'
        "parameters = { z = 0.1 }\n"
    )
    export_system(file, tmp_path / "car.ssp")
    with zipfile.ZipFile(tmp_path / "car.ssp") as archive:
        data = archive.read("resources/wheel.fmu")
    assert hashlib.sha256(data).hexdigest() == Contents.of(wheel).sha256

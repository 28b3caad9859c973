"""Export of a model as an FMI 3.0 co-simulation unit, by pythonfmu3: found laws are in it."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from table_io.errors import InputError, require_package
from table_io.records import RunStart
from twin.recording.reader import read_start
from twin.setup.run_config import read_model

EXTRA = "fmu"


def write_fmu(log: Path, model: str | None, path: Path) -> None:
    """Write the model of a log, or another one, at the specimen of its test, as a new FMU."""
    require_package("pythonfmu3", EXTRA, "--fmu")
    from pythonfmu3 import FmuBuilder

    start: RunStart = read_start(log)
    model_toml = start.model_toml if model is None else read_model(model, option="--model")[1]
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        script = folder / "fmu_unit.py"
        shutil.copyfile(Path(__file__).with_name("fmu_unit.py"), script)
        texts = {"profile.toml": start.profile_toml, "model.toml": model_toml}
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        built = FmuBuilder.build_FMU(
            script,
            dest=folder / "built",
            project_files=[folder / name for name in texts],
            **{"canHandleVariableCommunicationStepSize": False},
        )
        try:
            with path.open("xb") as file:
                file.write(Path(built).read_bytes())
        except FileExistsError:
            raise InputError(
                "exists already", where=path, remedy="nothing is ever overwritten"
            ) from None

"""Export of a model as an FMI 3.0 co-simulation unit: its solver as native code, without Python.

numba compiles the solver of the twin at the rate of the log, found laws included; a C compiler
links it with the functions of FMI in `fmu_unit.c`. The unit runs on systems like the one that wrote
it.
"""

import hashlib
import platform
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FunctionType
from typing import Any
from xml.sax.saxutils import quoteattr

import llvmlite.binding as llvm
from numba import carray, types

from table_io.block import Float1D
from table_io.compilation import inline_jit
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError, format_pip_line
from table_io.records import RunStart
from twin.laws.expression import build_function
from twin.model.closed_form import ClosedFormSolver, advance_samples
from twin.model.config import ModelConfig
from twin.model.event_integrator import EventDrivenSolver
from twin.model.event_integrator_kernel import build_kernel, integrate_samples
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.recording.reader import read_start
from twin.setup.run_config import read_model

EXTRA = "fmu"
NAME = "specimen"  # of the library in the unit
VARIABLES = {  # in the order of fmu_unit.c: causality and meaning
    "time": ("independent", "Time in s"),
    "table_acc_m_s2": ("input", "Acceleration of the table at the end of the step in m/s2"),
    "table_disp_m": ("input", "Displacement of the table at the end of the step in m, for tilt"),
    "rel_disp_m": ("output", "Displacement of the mass relative to the table in m"),
    "rel_vel_m_s": ("output", "Its velocity in m/s"),
    "mass_acc_m_s2": ("output", "Total acceleration of the mass in m/s2"),
    "force_r_n": ("output", "Force of the right bumper in N, 0 or more"),
    "force_l_n": ("output", "Force of the left bumper in N, 0 or less"),
}
STEP_SIGNATURE = (types.CPointer(types.float64),) * 4  # state, constants, inputs, out
MACHINES = {"AMD64": "x86_64", "arm64": "aarch64"}  # names of FMI, by those of Python
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}


def write_fmu(log: Path, model: str | None, path: Path) -> None:
    """Write the model of a log, or another one, at the specimen of its test, as a new FMU."""
    compiler = _find_compiler()
    start: RunStart = read_start(log)
    model_toml = start.model_toml if model is None else read_model(model, option="--model")[1]
    profile = parse_toml(start.profile_toml, Profile, "profile of the recording")
    specimen = parse_toml(model_toml, ModelConfig, "model").build_model(profile.specimen)
    code, rest, constants = compile_step(specimen, start.rate_hz)
    arrays = {"rest": rest, "constants": constants}
    header = _write_header(start.rate_hz, arrays)
    identity = hashlib.sha256(code + header.encode()).hexdigest()
    system, suffix = SYSTEMS[sys.platform]
    machine = MACHINES.get(platform.machine(), platform.machine())
    library = f"binaries/{machine}-{system}/{NAME}{suffix}"
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "step.o").write_bytes(code)
        (folder / "unit.h").write_text(f'#define IDENTITY "{identity}"\n{header}', "utf-8")
        built = folder / f"{NAME}{suffix}"
        source = Path(__file__).with_name("fmu_unit.c")
        files = (built, source, folder / "step.o")
        words = ["-O2", "-fPIC", "-shared", "-I", scratch, "-o", *map(str, files), "-lm"]
        result = subprocess.run([*compiler, *words], capture_output=True, text=True, check=False)
        if result.returncode:
            raise InputError(f"{compiler[0]} fails: {result.stderr.strip()[-300:]}", where="--fmu")
        contents: dict[str, str | bytes] = {
            "modelDescription.xml": _describe_unit(identity, start),
            library: built.read_bytes(),
            "resources/profile.toml": start.profile_toml,
            "resources/model.toml": model_toml,
        }
    with zipfile.ZipFile(path, "x", zipfile.ZIP_DEFLATED) as unit:
        for name, content in contents.items():
            unit.writestr(name, content)


def _find_compiler() -> list[str]:
    """Return the command of a C compiler: that of the system, else that of ziglang."""
    if command := shutil.which("cc"):
        return [command]
    if find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    raise InputError(
        "needs a C compiler, cc", where="--fmu", remedy=f"{format_pip_line(EXTRA)}, or install one"
    )


def compile_step(model: Model, rate_hz: float) -> tuple[bytes, Float1D, Float1D]:
    """Return (object code of a step of the solver, its state at rest, constants that it reads).

    Its function is `advance` of fmu_unit.c, with `out` as of `Solver.advance`.
    """
    solver = prepare_solver(model, rate_hz)
    state = solver.rest_state()
    size = state.size
    add_input = inline_jit(_build_input(model))
    if isinstance(solver, ClosedFormSolver):
        values, shape = solver.params, solver.params.shape

        def solve(state, constants, base, out):  # type: ignore[no-untyped-def]
            advance_samples(state, constants, base, out, out[:, :0])

    else:
        assert isinstance(solver, EventDrivenSolver)
        coefficients, laws = solver.coefficients, solver.laws
        values, shape = solver.propagators, solver.propagators.shape
        # Laws are compiled into it, as a pointer to them would be one of this process.
        kernel = build_kernel(False) if laws is None else inline_jit(integrate_samples)

        def solve(state, constants, base, out):  # type: ignore[no-untyped-def]
            kernel(state, coefficients, constants, laws, base, out, out[:, :0])

    solve_step = inline_jit(solve)

    def advance(state, constants, inputs, out):  # type: ignore[no-untyped-def]
        base, samples = carray(inputs, (1,)), carray(out, (OUTPUT_COUNT, 1))
        added = add_input(inputs[1])
        base[0] += added
        solve_step(carray(state, (size,)), carray(constants, shape), base, samples)
        samples[2, 0] -= added

    return _emit_object(advance), state, values.ravel()


def _build_input(model: Model) -> FunctionType:
    """Return what effects add to the table's acceleration in m/s2, by its displacement y in m."""
    terms = ["0.0"]
    for instance in model.present_effects:
        if instance.effect.place == "input":
            constants = instance.effect.work_out_constants({}, instance.values)
            names = {name: f"({value!r})" for name, value in constants.items()}
            terms.append(instance.effect.parsed_force.write_source(names))
    return build_function(f"def add_input(y):\n    return {' + '.join(terms)}")


def _emit_object(advance: Callable[..., None]) -> bytes:
    """Return the object code of a function of STEP_SIGNATURE, as `advance`, with what it calls."""
    dispatcher: Any = inline_jit(advance)
    dispatcher.compile(STEP_SIGNATURE)
    (compiled,) = dispatcher.overloads.values()
    module = llvm.parse_assembly(compiled.library.get_llvm_str())
    for function in module.functions:
        if function.name == compiled.fndesc.llvm_func_name:
            function.name, function.visibility = "advance", "hidden"
        elif not function.is_declaration:
            function.linkage = "internal"
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(opt=2, reloc="pic", codemodel="default")
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return bytes(machine.emit_object(module))


def _write_header(rate_hz: float, arrays: Mapping[str, Float1D]) -> str:
    """Return unit.h of fmu_unit.c."""
    lines = [
        f"#define STEP_S {(1.0 / rate_hz).hex()}",
        f"#define OUT_SIZE {OUTPUT_COUNT}",
    ]
    for name, values in arrays.items():
        numbers = ", ".join(value.hex().replace("inf", "INFINITY") for value in values.tolist())
        lines.append(f"static const double {name}[{values.size}] = {{{numbers}}};")
    return "\n".join(lines) + "\n"


def _describe_unit(identity: str, start: RunStart) -> str:
    """Return modelDescription.xml of a unit."""
    step = repr(1.0 / start.rate_hz)
    variables, outputs = "", ""
    for number, (name, (causality, meaning)) in enumerate(VARIABLES.items()):
        begin = ' start="0"' if causality == "input" else ""
        variables += (
            f'  <Float64 name="{name}" valueReference="{number}" causality="{causality}" '
            f'variability="continuous" description="{meaning}"{begin}/>\n'
        )
        outputs += f'  <Output valueReference="{number}"/>\n' if causality == "output" else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="3.0" modelName="{NAME}" '
        f'instantiationToken="{identity}" generationTool="shaketwin" '
        f"description={quoteattr(f'Specimen of {start.run} between two bumpers')}>\n"
        f' <CoSimulation modelIdentifier="{NAME}" fixedInternalStepSize="{step}" '
        'canHandleVariableCommunicationStepSize="true"/>\n'
        f' <DefaultExperiment startTime="0" stepSize="{step}"/>\n'
        f" <ModelVariables>\n{variables} </ModelVariables>\n"
        f" <ModelStructure>\n{outputs} </ModelStructure>\n</fmiModelDescription>\n"
    )

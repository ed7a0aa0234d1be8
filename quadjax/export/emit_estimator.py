"""The emitted disturbance estimator: one header and one source."""

import numpy as np

from quadjax.export import estimator_emulator
from quadjax.export.emit_network import Provenance
from quadjax.export.estimator_tables import (
    DIFFERENCE_BITS,
    FINE_BITS,
    LOW_PASS_BITS,
    MODEL_BITS,
    MONOMIALS,
    Q30,
    RESIDUAL_LIMIT,
    EstimatorTables,
    FixedResidual,
)
from quadjax.export.render import comment, fill, literal, table, wrapped

TEST_ROWS, SELF_TESTS = 16, 64


def test_measurements(tables: EstimatorTables) -> np.ndarray:
    """Measurements (rows, 13) float32 of a drone that is thrown about."""
    rng = np.random.default_rng(0)
    limit = np.ldexp(1.0, np.asarray(tables.exponents))
    rows = rng.uniform(-0.3, 0.3, (TEST_ROWS, len(limit))) * limit
    rows[:, 6:10] = np.abs(rows[:, 6:10]) * 2.0
    rows[-1] *= 8.0  # clipped
    rows[-2, 2] = np.nan
    return rows.astype(np.float32)


def emit_estimator(
    tables: EstimatorTables, origin: Provenance, residual_hash: str
) -> dict[str, str]:
    """The header and the source, by file name; ``residual_hash`` is empty without a residual."""
    ranges = [f"{2.0**e:g}" for e in tables.exponents]
    rate = f"{tables.sample_rate:g}"
    values = {
        "name": origin.name,
        "NAME": origin.name.upper(),
        "provenance": comment(origin.lines),
        "cutoff": f"{tables.cutoff:g}",
        "sample_rate": rate if "." in rate else f"{rate}.0",
        "residual_hash": residual_hash,
        "gyro_range": ranges[0],
        "force_range": ranges[3],
        "rpm_range": ranges[6],
        "velocity_range": ranges[10],
        "model_bits": str(MODEL_BITS),
        "difference_bits": str(DIFFERENCE_BITS),
        "low_pass_bits": str(LOW_PASS_BITS),
        "fine_bits": str(FINE_BITS),
        "gain": str(tables.gain),
        "a1": str(tables.a1),
        "a2": str(tables.a2),
        "exponents": ", ".join(map(str, tables.exponents)),
        "channel_units": wrapped(
            [f"{2.0 ** (e - Q30)!r}F" for e in tables.channel_exponents]
        ).strip(),
        "unused": _unused(tables),
        "model": _rows("x", tables.model, "MODEL_BITS"),
        "differentiated": _rows("d", tables.differentiated, "DIFFERENCE_BITS"),
        "residual_call": "" if tables.thrust is None else "  subtract_residual(s, x);",
    }
    values |= _tests(tables)
    values["residual"] = "" if tables.thrust is None else _residual(tables)
    return {
        f"{origin.name}_estimator.h": fill("estimator.h.in", values),
        f"{origin.name}_estimator.c": fill("estimator.c.in", values),
    }


def _rows(target: str, coefficients: np.ndarray, bits: str) -> str:
    """Sums of monomials, one statement a row."""
    names = {"a_x": "s[3]", "a_y": "s[4]", "a_z": "s[5]"}
    lines = []
    for index, row in enumerate(coefficients.tolist()):
        terms = [
            f"INT64_C({value}) * {names.get(name, name)}"
            for name, value in zip(MONOMIALS, row, strict=True)
            if value
        ]
        total = " +\n                     ".join(terms) or "0"
        lines.append(f"  {target}[{index}] = round_shift({total},\n                     {bits});")
    return "\n".join(lines)


def _unused(tables: EstimatorTables) -> str:
    """Statements that keep a compiler quiet about products that this vehicle's model has not."""
    used = np.any(tables.model != 0, axis=0) | np.any(tables.differentiated != 0, axis=0)
    names = [name for name, needed in zip(MONOMIALS, used, strict=True) if not needed]
    return "\n".join(f"  (void){name};" for name in names if not name.startswith("a_"))


def _residual(tables: EstimatorTables) -> str:
    dimensions, text, calls, widest = [], [], [], 1
    deepest = 0
    networks = (("thrust", tables.thrust, "x[5]"), ("moment", tables.moment, "x[{row}]"))
    for name, network, target in networks:
        assert network is not None
        source, columns = "input", network.output.weights.shape[1]
        for index, layer in enumerate(network.hidden):
            rows, columns = layer.weights.shape
            widest, deepest = max(widest, rows), max(deepest, index + 1)
            upper = f"{name.upper()}_{index}"
            dimensions.append(f"  {upper}_ROWS = {rows}, {upper}_COLUMNS = {columns},")
            text += _layer_tables(f"{name}_{index}", layer.weights, layer.bias)
            result = ("a", "b")[index % 2]
            calls.append(
                f"  relu_layer({name}_{index}_weight, {name}_{index}_bias, {upper}_ROWS, "
                f"{upper}_COLUMNS, {source}, {result});"
            )
            source, columns = result, rows
        text += _layer_tables(f"{name}_output", network.output.weights, network.output.bias)
        calls += _output_calls(name, network, target, source, columns)
    r = tables.rpm_input
    assert r is not None
    return fill(
        "residual.c.in",
        {
            "dimensions": "\n".join(dimensions),
            "widest": str(widest),
            "limit": str(RESIDUAL_LIMIT),
            "tables": "\n".join(text),
            "calls": "\n".join(calls),
            "second_buffer": "  int32_t b[RESIDUAL_WIDEST];\n" if deepest > 1 else "",
            "rpm_middle": str(r.middle),
            "rpm_factor": str(r.factor),
            "rpm_shift": str(r.shift),
        },
    )


def _layer_tables(name: str, weights: np.ndarray, bias: np.ndarray) -> list[str]:
    return [
        table("int32_t", f"{name}_weight", str(weights.size), weights),
        table("int64_t", f"{name}_bias", str(bias.size), bias),
    ]


def _output_calls(
    name: str, network: FixedResidual, target: str, source: str, columns: int
) -> list[str]:
    calls = []
    for row, shift in enumerate(network.shifts):
        total = (
            f"row_sum(&{name}_output_weight[{row * columns}], {name}_output_bias[{row}], "
            f"{source}, {columns}U)"
        )
        calls.append(f"  {target.format(row=row)} -= held(round_shift({total}, {shift}));")
    return calls


def _tests(tables: EstimatorTables) -> dict[str, str]:
    measured = test_measurements(tables)
    memory = estimator_emulator.start(tables, measured[:1])
    rows = []
    for sample in range(SELF_TESTS):
        row = measured[sample % TEST_ROWS][None]
        y = estimator_emulator.update(tables, memory, row)[0] >> (FINE_BITS - Q30)
        rows.append("    {" + ", ".join(literal(int(v)) for v in y) + "}")
    bits = measured.view(np.uint32).tolist()
    inputs = ["    {" + wrapped([f"0x{b:08X}U" for b in r], "     ").strip() + "}" for r in bits]
    return {
        "self_tests": str(SELF_TESTS),
        "test_rows": str(TEST_ROWS),
        "test_measurements": ",\n".join(inputs),
        "test_outputs": ",\n".join(rows),
    }

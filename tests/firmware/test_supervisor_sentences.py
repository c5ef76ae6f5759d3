"""Sentences on safety, proven on the generated C of the supervisor itself by Frama-C Eva 25.0, an abstract interpreter.

Each holds for one sample from any memory within the bounds below, with any readings, requests and counts, NaN and
infinity too, and for any law: `ctl_step` writes what it likes into its estimates and outputs. What monitors remember is
within the same bounds after a sample, by the first sentence; so each holds for all samples. `arbitrary`
takes that the places of references are within what can be read.

Eva assumes C99 on a 64-bit processor, IEEE 754 double precision rounded to the nearest, no contraction, and a correctly
rounded sqrt. It does not see that `x <= y` and `x > y` are false of a NaN: `value == value`, which is then true, stands
before it in the text that is analysed; nothing else is changed. No law is proven, nor what a reaction does to the
machine.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from exported import run, target

from malta.firmware.signals import Target
from malta.firmware.sources import sources
from malta.firmware.supervisor import (
    EXCITATION_SHARE,
    bounds_of,
    gains_without,
    monitor_names,
    monitors_of,
    stars_of,
)
from malta.firmware.supervisor_text import Member, request_members, supervisor_members, supervisor_sources

EVA = (
    *("frama-c", "-eva", "-machdep", "gcc_x86_64", "-warn-special-float", "none", "-eva-precision", "3"),
    *("-eva-split-return-function", "is_within:0:1,is_flying:0:1", "-eva-subdivide-non-linear", "50"),
    *("-eva-slevel-function", "look_at_sensor:2000,guide:1000,steer:1000,gates:1000", "-eva-no-print"),
    *("-eva-msg-key=--initial-state,-final-states", "-inline-calls", "ctl_supervisor_step"),
    *("-eva-no-alloc-returns-null", "-cpp-extra-args=-D__NO_MATH_ERRNO__ -D__SSE2__ -D__builtin_sqrt=sqrt"),
)
COMPARED = "return ((value <= most) && (value >= -most)) ? 1 : 0;"
HINTS = (  # to the analyser: what is true of what is compared, and cases to look at one by one
    (COMPARED, COMPARED.replace("((value", "((value == value) && (value", 1)),
    ("  remember(sup, request);\n", "  remember(sup, request);\n  //@ split sup->state;\n"),
    ("bounded = (value > low)", "bounded = ((value == value) && (value > low))"),
)
MORE_HINTS = {"references": HINTS[1:2], "leaps": HINTS[2:]}
SAMPLES = 1_000_000_000  # the longest count
# What is remembered: the least and the largest, of a unit each; of others, anything.
INTEGERS = {
    **dict.fromkeys(("fit", "followed", "paced", "commanded"), (0, 1)),
    **dict.fromkeys(("seeing", "steered"), (0, "OUTPUTS")),
    "state": (0, 8),
    "leapt": (-1, "OUTPUTS - 1"),
    "samples": (0, SAMPLES + 2_000_000),
}
REALS = {
    **dict.fromkeys(("last", "i_before", "raw_current", "rest", "offset"), 1e30),
    **dict.fromkeys(("error", "off_mean", "beyond_mean"), 2e30),
    **dict.fromkeys(("noise", "usual"), 1.0),
    **dict.fromkeys(("d0", "d1", "d2", "asked_rate"), 1e6),
    "late": 1.1,
    "unrest": 2e30,
    "leap": 1.0,
}
RANGES = {**dict.fromkeys(("since", "place", "asked", "away"), 1), "shift": 2}  # times what can be read
POSITIVE = ("lasts", "stops")
HELD = ("noise", "usual", "error", "late", "last", "off_mean", "beyond_mean", "i_before", "raw_current")
LEAPT = ("away", "shift", "unrest", "leap")

HARNESS = """
#include <math.h>
#include "ctl_supervisor.c"
#include "__fc_builtin.h"
#define REAL(a) Frama_C_double_interval(-(a), a)

static volatile double any;
static volatile int32_t whole;
static ctl_supervisor sup;
static ctl_state s;
static ctl_inputs in;
static ctl_outputs out;
static ctl_request q;

int32_t ctl_self_test(void) { return Frama_C_interval(0, 1); }

static void forget(void) {
  for (int k = 0; k < (int)(sizeof s.xi_pred / sizeof(double)); k++) { s.xi_pred[k] = any; }
@OUT
}

void ctl_step(ctl_state *a, const ctl_inputs *b, ctl_outputs *c) { (void)a; (void)b; (void)c; forget(); }
void ctl_start(ctl_state *a) { (void)a; forget(); }

static void arbitrary(int state) {
  ctl_supervisor_init(&sup);
@MEMORY
  sup.state = state;
  sup.enable = is_flying(state);
  for (int k = 0; k < OUTPUTS; k++) {
    s.reference.p[k] = REAL(range[k]);
    s.reference.dp[k] = REAL(1e6);
    s.reference.ddp[k] = REAL(1e6);
    q.reference.p[k] = any;
    q.reference.dp[k] = any;
    q.reference.ddp[k] = any;
  }
@REQUESTS
@INPUTS
  forget();
}

#define step() ctl_supervisor_step(&sup, &s, &in, &q, &out)
#define EACH_STATE /*@ loop unroll 9; */ for (int state = CTL_OFF; state <= CTL_FAULT; state++)

/* 1. No NaN survives a sample: what monitors remember is finite, and within the bounds that it had. */
void no_number(void) {
  EACH_STATE {
    double expected[OUTPUTS];
    double level[@MONITORS][OUTPUTS];
    arbitrary(state);
@INFER
    expect(&sup, &s, &in, expected);
    look(&sup, &s, &in, &q, expected, level);
@SANE
  }
}

/* 2. The tolerance of an ignored sensor never exceeds its bound, and in flight it has one for a while alone. */
void tolerance(void) {
  EACH_STATE {
    //@ loop unroll OUTPUTS;
    for (int k = 0; k < OUTPUTS; k++) {
      static const double most[OUTPUTS] = { @NEAREST };
      const double strange = Frama_C_double_interval(most[k] * (1 + 1e-12), 1e30);
      arbitrary(state);
      sup.usual[k] = 0.0;
      int32_t found = agrees(&sup, strange, any, Frama_C_double_interval(0.0, 1e300), k);
      //@ assert nearer: found == 0;
      arbitrary(state);
      const int own = (state == CTL_LANDING) ? @BRIDGED : @UNBELIEVED;
      sup.unbelieved[k] = Frama_C_interval(own + 1, @LONGEST);
      found = agrees(&sup, any, any, any, k);
      //@ assert later: (3 <= state <= 7) ==> found == 0;
    }
  }
}

/* 3. A request to stop and safe torque off open the gates in the same sample, from every state. */
void stops(void) {
  EACH_STATE {
    for (int by = 0; by < 2; by++) {
      arbitrary(state);
      q.stop = by ? q.stop : 1;
      q.sto = by ? 1 : q.sto;
      step();
      //@ assert off: sup.enable == 0;
    }
  }
}

/* 4. A fault is left by an edge of acknowledge alone, without stop and without safe torque off. */
void faults(void) {
  for (int by = 0; by < 4; by++) {
    arbitrary(CTL_FAULT);
    if (by == 0) { q.acknowledge = 0; }
    if (by == 1) { sup.acknowledged = 1; }
    if (by == 2) { q.stop = 1; }
    if (by == 3) { q.sto = 1; }
    step();
    //@ assert stays: sup.state == 8 && sup.enable == 0;
  }
}

/* 5. A machine that is off starts by an edge of its request alone, with the arithmetic of the text, without a stop. */
void starts(void) {
  for (int by = 0; by < 5; by++) {
    arbitrary(CTL_OFF);
    if (by == 0) { q.start = 0; }
    if (by == 1) { sup.started = 1; }
    if (by == 2) { q.stop = 1; }
    if (by == 3) { q.sto = 1; }
    if (by == 4) { sup.fit = 0; }
    step();
    //@ assert stays: sup.state == 0 && sup.enable == 0;
  }
}

/* 6. Gates are on in flight alone; elsewhere bridges rest and no force is commanded. */
void gates(void) {
  EACH_STATE {
    arbitrary(state);
    step();
    const int32_t flies = is_flying(sup.state);
    //@ assert gates: sup.enable == flies;
    if (sup.enable == 0) {
      for (int k = 0; k < (int)(sizeof out.v / sizeof(double)); k++) {
        //@ assert force: out.v[k] == 0.0;
      }
    }
  }
}

/* 7. Every row of the table acts in every state of its mask, whatever the others count, when its level has been over
   its threshold for its samples: and at once, in the sample that completes them. */
void rows(void) {
  static double level[@MONITORS][OUTPUTS];
  EACH_STATE {
    arbitrary(state);
    //@ loop unroll CTL_MONITOR_ROWS;
    for (int r = 0; r < CTL_MONITOR_ROWS; r++) {
      if (((ctl_monitors[r].states >> state) & 1u) == 1u) {
        const int k = OUTPUTS - 1;
        for (int m = 0; m < @MONITORS; m++) {
          for (int j = 0; j < OUTPUTS; j++) { level[m][j] = any; }
        }
        level[ctl_monitors[r].monitor][k] = Frama_C_double_interval(ctl_monitors[r].threshold * (1 + 1e-12), 1e300);
        sup.count[(r * OUTPUTS) + k] = Frama_C_interval(ctl_monitors[r].samples - 1, @LONGEST);
        if (ctl_monitors[r].monitor == CTL_MONITOR_UNBELIEVED) { sup.unbelieved[k] = Frama_C_interval(1, @LONGEST); }
        const int32_t found = judge(&sup, level);
        const int32_t least = ctl_monitors[r].reaction;
        //@ assert heard: found >= least;
      }
    }
  }
}

/* 8. A reaction is followed in its sample: a fault opens the gates, a landing begins, goes on or ends. */
void reactions(void) {
  //@ loop unroll 7;
  for (int state = CTL_OFFSETS; state <= CTL_LANDING; state++) {
    arbitrary(state);
    int32_t event = event_of(&sup, &q, CTL_REACTION_FAULT);
    change_state(&sup, &s, &q, event);
    //@ assert fault: sup.state == 8;
    arbitrary(state);
    event = event_of(&sup, &q, CTL_REACTION_LAND);
    change_state(&sup, &s, &q, event);
    //@ assert lands: sup.state == 0 || (state >= 3 && sup.state == 7);
  }
}

/* 9. A landing ends: after its time the machine is off or in fault. test_supervisor_relation.py: each sample counts. */
void landings(void) {
  arbitrary(CTL_LANDING);
  sup.samples = Frama_C_interval(sup.times.landing + sup.times.settle, @LONGEST);
  step();
  //@ assert ends: sup.state == 0 || sup.state == 8;
}

/* 10. No request takes a reference of operation beyond what can be read. */
void references(void) {
  arbitrary(CTL_OPERATE);
  step();
  if (sup.state == CTL_OPERATE) {
    for (int k = 0; k < OUTPUTS; k++) {
      const double most = range[k];
      const double found = s.reference.p[k];
      //@ assert within: -most <= found <= most;
    }
  }
}
@EXCITATION
@LEAPS
"""
EXCITATION = """
/* 11. An excitation acts in operation alone, within its limit. */
void excitations(void) {
  static const double most[] = { @MOST };
  EACH_STATE {
    arbitrary(state);
    gate_excitation(&sup, &in);
    for (int k = 0; k < (int)(sizeof most / sizeof(double)); k++) {
      const double e = in.excitation[k];
      const double limit = (state == CTL_OPERATE) ? most[k] : 0.0;
      //@ assert within: -limit <= e <= limit;
    }
  }
}
"""
LEAPS = """
/* 12. What is remembered of leaps stays finite, whatever the filter expects. */
void leaps(void) {
  EACH_STATE {
    double expected[OUTPUTS];
    double level[@MONITORS][OUTPUTS];
    arbitrary(state);
    for (int k = 0; k < OUTPUTS; k++) {
      expected[k] = any;
      for (int m = 0; m < @MONITORS; m++) { level[m][k] = any; }
    }
    look_for_leaps(&sup, &in, Frama_C_interval(0, @LONGEST), expected, level);
@LEAPT
  }
}
"""
SENTENCES = {  # and how many assertions each consists of, in a machine of one sensor without currents
    **dict.fromkeys(("stops", "faults", "starts", "rows", "landings", "references", "excitations"), 1),
    **dict.fromkeys(("tolerance", "gates", "reactions"), 2),
    "no_number": 5,
}
FAST = ("tolerance", "faults")


@pytest.mark.parametrize(
    "sentence", [pytest.param(key, marks=[] if key in FAST else [pytest.mark.slow]) for key in SENTENCES]
)
def test_a_sentence_is_proven_on_the_generated_code(sentence: str, tmp_path: Path) -> None:
    proven, unproven, alarms = prove(machine(), tmp_path, sentence)
    assert (proven, unproven, alarms) == (SENTENCES[sentence], 0, 0)


SHIFTED = ";\n      sup->shift"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "unproven"),
    [(("", ""), 0), ((f"between(-range[k], away, range[k]){SHIFTED}", f"away{SHIFTED}"), 3)],
)
def test_what_is_remembered_of_leaps_is_finite(
    change: tuple[str, str], unproven: int, tmp_path: Path
) -> None:
    """Of MALTA with five sensors, of which the Halbach motor has none to compare."""
    machine()  # skips without Frama-C
    found = prove(target("robust", "double"), tmp_path, "leaps", change)
    assert found == (len(LEAPT) - unproven, unproven, 0)


# A sentence, and a change of the text after which it is false: Eva must not prove it.
WRONG = (
    ("tolerance", "const bool soon = (", "const bool soon = true || ("),
    ("tolerance", "((grown < nearest[k]) ? grown : nearest[k])", "(grown)"),
    ("faults", "(sup->acknowledged == 0) && is_free(request)", "(sup->acknowledged == 0)"),
    ("starts", "(sup->state == CTL_OFF) && (sup->fit == 1)", "(sup->state == CTL_OFF)"),
    ("reactions", "{ CTL_LANDING, EVENT_FAULT, CTL_FAULT }", "{ CTL_LANDING, EVENT_FAULT, CTL_LIFT }"),
    ("landings", "(sup->times.landing + sup->times.settle)", "(2 * sup->times.landing)"),
    ("no_number", "if (is_within(value, 1e+30) == 1) {", "if (share > 0.0) {"),
    ("no_number", "(is_number == 1) && (in->y_valid[k] > 0.5)", "(in->y_valid[k] > 0.5)"),
    (
        "stops",
        "level[CTL_MONITOR_STO][0] = (request->sto != 0)",
        "level[CTL_MONITOR_STO][0] = (request->sto > 1)",
    ),
    ("gates", "sup->enable = is_flying(sup->state);", "sup->enable = is_flying(sup->reaction);"),
    ("references", "last->p[k] = between(-end, ", "last->p[k] = between(-2.0 * end, "),
    ("excitations", "bool used = sup->state == CTL_OPERATE;", "bool used = sup->state != CTL_LANDING;"),
)


@pytest.mark.parametrize(
    ("sentence", "old", "new"),
    [pytest.param(*row, marks=[] if row[0] in FAST[1:] else [pytest.mark.slow]) for row in WRONG],
)
def test_a_wrong_text_is_not_proven(sentence: str, old: str, new: str, tmp_path: Path) -> None:
    assert prove(machine(), tmp_path, sentence, (old, new))[1] > 0


@cache
def machine() -> Target:
    """The Halbach motor: one sensor, states that are estimated, an excitation."""
    if shutil.which("frama-c") is None:
        pytest.skip("frama-c-base of Debian 12, Frama-C 25.0, is not installed")
    return replace(target("halbach", "double"), excited=True)


def text(t: Target) -> str:
    """The C of the sentences for a target."""
    b, p = bounds_of(t), len(t.controller.measurements)
    values = {
        "EXCITATION": EXCITATION if t.excited else "",
        "LEAPS": LEAPS if gains_without(t).L else "",
        "MOST": ", ".join(repr(EXCITATION_SHARE * float(v)) for v in t.controller.limits.force),
        "OUT": "\n".join(_any(f"out.{f.name}", f.size) for f in t.output_fields if f.size),
        "INPUTS": "\n".join(_any(f"in.{f.name}", f.size) for f in t.input_fields if f.size),
        "REQUESTS": "\n".join(f"  q.{m.name} = whole;" for m in request_members() if m.kind == "int32_t"),
        "INFER": "    infer_currents(&sup, &in);" if stars_of(t) else "",
        "MEMORY": "\n".join(_memory(m) for m in supervisor_members(t) if m.kind != "times"),
        "SANE": "\n".join(_sane(m) for m in supervisor_members(t) if m.name in HELD),
        "LEAPT": "\n".join(_sane(m) for m in supervisor_members(t) if m.name in LEAPT),
        "NEAREST": ", ".join(repr(float(v)) for v in b.nearest),
        "BRIDGED": str(b.bridged),
        "UNBELIEVED": str(b.unbelieved),
        "MONITORS": str(len(monitor_names(t))),
        "LONGEST": str(SAMPLES),
    }
    found = HARNESS
    for key, value in values.items():
        found = found.replace(f"@{key}", value)
    return found.replace("unroll OUTPUTS", f"unroll {p}").replace(
        "unroll CTL_MONITOR_ROWS", f"unroll {len(monitors_of(t))}"
    )


def _any(place: str, size: int) -> str:
    return f"  for (int k = 0; k < {size}; k++) {{ {place}[k] = any; }}"


def _memory(m: Member) -> str:
    """An entry of the memory before a sample."""
    low, high = INTEGERS.get(m.name, (0, SAMPLES))
    if m.name in ("started", "acknowledged", "monitor", "reaction"):
        value = "whole"
    elif m.kind == "int32_t":
        value = f"Frama_C_interval({low}, {high})"
    elif m.name in RANGES:
        value = f"REAL({RANGES[m.name]} * range[k])"
    elif m.name in POSITIVE:
        value = "Frama_C_double_interval(CTL_SAMPLE_TIME, 1e3)"
    else:
        value = f"REAL({REALS[m.name]})" if m.name in REALS else "any"
    if not m.size:
        return f"  sup.{m.name} = {value};"
    return f"  for (int k = 0; k < {m.size}; k++) {{ sup.{m.name}[k] = {value}; }}"


def _sane(m: Member) -> str:
    """That an entry of the memory is within its bounds after a sample."""
    bound = REALS[m.name] if m.name in REALS else f"{RANGES[m.name]} * range[k]"
    loop = f"for (int k = 0; k < {m.size or 1}; k++)"
    entry = f"sup.{m.name}{'[k]' if m.size else ''}"
    proof = f"/*@ assert {m.name}: -most <= held <= most; */"
    return f"    {loop} {{ const double held = {entry}, most = {bound}; {proof} }}"


def prove(t: Target, folder: Path, sentence: str, change: tuple[str, str] = ("", "")) -> tuple[int, int, int]:
    """How many assertions of a sentence are proven, how many are not, and alarms. change: of the supervisor's text"""
    files = sources(t, "", "ctl") | supervisor_sources(t, "ctl")
    own = files["ctl_supervisor.c"]
    for old, new in (HINTS[0], *MORE_HINTS.get(sentence, ()), change):
        assert not old or own.count(old) == 1, old
        own = own.replace(old, new) if old else own
    for name, content in (files | {"ctl_supervisor.c": own, "sentences.c": text(t)}).items():
        (folder / name).write_text(content, encoding="utf-8")
    done = run([*EVA, "-main", sentence, str(folder / "sentences.c")], folder)
    assert done.returncode == 0, done.stdout[-3000:]
    assertions = re.search(r"Assertions +(\d+) valid +(\d+) unknown +(\d+) invalid +(\d+) total", done.stdout)
    alarms = re.search(r"(\d+) alarms? generated", done.stdout)
    assert assertions, done.stdout[-3000:]
    assert alarms, done.stdout[-3000:]
    valid, unknown, invalid, _ = (int(n) for n in assertions.groups())
    return valid, unknown + invalid, int(alarms[1])

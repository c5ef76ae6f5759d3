"""The transition relation of the generated supervisor, all of it: states, reactions, requests, and rows by pairs.

The C of the supervisor is included, so that its own functions decide; nothing is sampled.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exported import EXACT, require, run, target, write_folder

from malta.firmware.supervisor import IN_FLIGHT, IN_USE, STATES, TRANSITIONS, monitors_of

NUMBERS = {state: k for k, state in enumerate(STATES)}
RELATION = """
#include <math.h>
#include <stdio.h>
#include "ctl_supervisor.c"

static const int allowed[][2] = { @PAIRS };
static const ctl_real most[] = { @CURRENTS };
static long tried;
static long wrong;

static void require(int holds, const char *what, int from, int by, int to) {
  tried++;
  if (!holds) {
    wrong++;
    if (wrong < 20) { printf("%s: %d, %d, %d\\n", what, from, by, to); }
  }
}

static int is_awake(int state) { return (state != CTL_OFF) && (state != CTL_FAULT); }

static int is_possible(int state, int reaction) {
  int found = reaction == CTL_REACTION_NONE;
  for (int r = 0; r < CTL_MONITOR_ROWS; r++) {
    found = found || ((ctl_monitors[r].reaction == reaction) && ((ctl_monitors[r].states >> state) & 1u));
  }
  return found;
}

static void prepare(ctl_supervisor *sup, ctl_state *s, ctl_request *q, int state, int bits) {
  static const ctl_request nothing;
  static const ctl_real rest[OUTPUTS];
  ctl_init(s);
  ctl_start(s);
  ctl_supervisor_take_over(sup, rest);
  *q = nothing;
  sup->state = state;
  sup->enable = is_flying(state);
  q->start = bits & 1;
  sup->started = (bits >> 1) & 1;
  q->acknowledge = (bits >> 2) & 1;
  sup->acknowledged = (bits >> 3) & 1;
  q->stop = (bits >> 4) & 1;
  q->sto = (bits >> 5) & 1;
  q->land = (bits >> 6) & 1;
  q->operate = (bits >> 7) & 1;
  sup->steady = ((bits >> 8) & 1) ? 100000 : 0;
  sup->samples = ((bits >> 9) & 1) ? sup->times.landing + sup->times.settle : 0;
  sup->fit = (bits >> 10) & 1;
}

/* What must hold of a step, whatever made it. */
static void judge_step(const ctl_supervisor *before, const ctl_request *q, int reaction, int done, int to) {
  const int from = before->state;
  const int free = (q->stop == 0) && (q->sto == 0);
  const int lands = (reaction == CTL_REACTION_LAND) || (q->land != 0);
  int listed = from == to;
  for (unsigned k = 0; k < sizeof allowed / sizeof allowed[0]; k++) {
    listed = listed || ((allowed[k][0] == from) && (allowed[k][1] == to));
  }
  require(listed, "not of the table", from, reaction, to);
  if (is_awake(from) && (reaction == CTL_REACTION_FAULT)) {
    require(to == CTL_FAULT, "a fault goes on", from, reaction, to);
  } else if (is_flying(from) && lands) {
    const int ended = (from == CTL_LANDING) && done && (to == CTL_OFF);
    require((to == CTL_LANDING) || ended, "no landing", from, reaction, to);
  } else if (is_awake(from) && lands) {
    require(to == CTL_OFF, "on the ground, not off", from, reaction, to);
  }
  if (from == CTL_FAULT) {
    const int asked = (q->acknowledge != 0) && (before->acknowledged == 0) && free;
    require((to == CTL_FAULT) || asked, "a fault is left", from, reaction, to);
    require((to == CTL_OFF) || !asked || lands, "a fault stays", from, reaction, to);
  }
  if (from == CTL_OFF) {
    const int asked = (q->start != 0) && (before->started == 0) && free && (before->fit == 1);
    require((to == CTL_OFF) || asked, "it starts", from, reaction, to);
    require((to == CTL_OFFSETS) || !asked || lands, "it does not start", from, reaction, to);
  }
  if (!is_flying(from) && is_flying(to)) {
    require((from == CTL_SENSORS) && (to == CTL_LIFT) && done && !lands, "it lifts off", from, reaction, to);
  }
  if ((from == CTL_LANDING) && done && (reaction != CTL_REACTION_FAULT)) {
    require(to == CTL_OFF, "a landing without an end", from, reaction, to);
  }
  if ((from == CTL_LANDING) && (before->samples >= (before->times.landing + before->times.settle))) {
    require(done, "a landing takes longer", from, reaction, to);
  }
}

/* Every state, reaction, request, edge and end of a wait. */
static void try_events(void) {
  static ctl_supervisor sup, before;
  static ctl_state s;
  static ctl_request q;
  for (int state = 0; state < @STATES; state++) {
    for (int reaction = 0; reaction <= CTL_REACTION_FAULT; reaction++) {
      for (int bits = 0; is_possible(state, reaction) && (bits < 2048); bits++) {
        prepare(&sup, &s, &q, state, bits);
        before = sup;
        const int done = is_done(&sup, &q);
        change_state(&sup, &s, &q, event_of(&sup, &q, reaction));
        judge_step(&before, &q, reaction, done, sup.state);
        const int counts = (sup.state == state) ? (sup.samples > before.samples) : (sup.samples == 0);
        require(counts, "time", state, reaction, sup.state);
      }
    }
  }
}

/* Each pair of rows that act in a state: the reaction is as strong as theirs. No row counts where gates are off. */
static void try_rows(void) {
  static ctl_supervisor sup;
  static ctl_state s;
  static ctl_request q;
  for (int state = 0; state < @STATES; state++) {
    for (int a = 0; a < CTL_MONITOR_ROWS; a++) {
      for (int b = a; b < CTL_MONITOR_ROWS; b++) {
        static ctl_real level[@MONITORS][OUTPUTS];
        const int rows[2] = { a, b };
        int expected = CTL_REACTION_NONE;
        for (int m = 0; m < @MONITORS; m++) {
          for (int k = 0; k < OUTPUTS; k++) { level[m][k] = 0; }
        }
        prepare(&sup, &s, &q, state, 0);
        for (int n = 0; n < 2; n++) {
          const ctl_monitor *row = &ctl_monitors[rows[n]];
          level[row->monitor][OUTPUTS - 1] = (2 * row->threshold) + 1;
          sup.count[(rows[n] * OUTPUTS) + OUTPUTS - 1] = row->samples - 1;
          if (row->monitor == CTL_MONITOR_UNBELIEVED) { sup.unbelieved[OUTPUTS - 1] = 1; }
          if (((row->states >> state) & 1u) && (row->reaction > expected)) { expected = row->reaction; }
        }
        const int found = judge(&sup, level);
        require(found >= expected, "a row is not heard", state, a, b);
        require(is_awake(state) || (found == CTL_REACTION_NONE), "a row counts while it is off", state, a, b);
      }
    }
  }
}

/* One whole step from each state, with each request and these readings: gates and outputs are those of the state. */
static void try_steps(void) {
  static ctl_supervisor sup, before;
  static ctl_state s;
  static ctl_request q;
  static ctl_inputs in;
  static ctl_outputs out;
  const ctl_real readings[3] = { 0, (ctl_real)NAN, (ctl_real)1e9 };
  for (int state = 0; state < @STATES; state++) {
    for (int bits = 0; bits < 2048; bits++) {
      for (int kind = 0; kind < @KINDS; kind++) {
        prepare(&sup, &s, &q, state, bits);
        for (int k = 0; k < OUTPUTS; k++) { in.y[k] = readings[kind % 3]; in.y_valid[k] = 1; }
        q.reference.p[0] = readings[(kind / 3) % 3];
        q.missed = ((kind / 9) % 2) * 1000;
@DRIVEN
        before = sup;
        ctl_supervisor_step(&sup, &s, &in, &q, &out);
        const int now = sup.state;
        require(sup.enable == is_flying(now), "gates", state, kind, now);
        const int free = (q.stop + q.sto) == 0;
        const int asked = free && (q.acknowledge > before.acknowledged);
        require(!is_awake(state) || free || (now == CTL_FAULT), "a stop is not heard", state, kind, now);
        require((now == CTL_FAULT) || (state != CTL_FAULT) || asked, "a fault is left", state, kind, now);
        for (unsigned k = 0; k < sizeof out.v / sizeof out.v[0]; k++) {
          require(isfinite(out.v[k]) && (is_flying(now) || (out.v[k] == 0)), "a force", state, kind, now);
        }
        for (unsigned k = 0; k < sizeof out.current / sizeof out.current[0]; k++) {
          const ctl_real limit = is_flying(now) ? most[k] : 0;
          require((out.current[k] <= limit) && (out.current[k] >= -limit), "a current", state, kind, now);
        }
@COMMAND
      }
    }
  }
}

int main(void) {
  try_events();
  try_rows();
  try_steps();
  printf("%ld wrong of %ld\\n", wrong, tried);
  return wrong > 0;
}
"""
DRIVEN = """
        for (int k = 0; k < @READ; k++) { in.i[k] = readings[(kind / 18) % 3]; in.i_valid[k] = 1; }
        in.link[0] = ((kind / 54) % 2) ? (ctl_real)NAN : (ctl_real)@LINK;
"""
COMMAND = """
        for (unsigned k = 0; k < sizeof out.command / sizeof out.command[0]; k++) {
          const int fits = is_flying(now) ? isfinite(out.command[k]) : (out.command[k] == (ctl_real)0.5);
          require(fits, "a duty cycle", state, kind, now);
        }
"""


def relation(name: str) -> str:
    """The program for a design."""
    t = target(name, "double")
    pairs = sorted({(NUMBERS[a], NUMBERS[b]) for a, _, b in TRANSITIONS})
    currents = np.broadcast_to(t.controller.limits.current, len(t.believed.actuator.coils))
    values = {
        "PAIRS": ", ".join(f"{{ {a}, {b} }}" for a, b in pairs),
        "CURRENTS": ", ".join(repr(float(limit)) for limit in currents),
        "STATES": str(len(STATES)),
        "MONITORS": "(CTL_MONITOR_STO + 1)",
        "KINDS": "108" if t.driven else "18",
        "DRIVEN": DRIVEN if t.driven else "",
        "COMMAND": COMMAND if t.driven else "",
        "READ": "(int)(sizeof in.i / sizeof in.i[0])",
        "LINK": repr(float(t.believed.drive.link_voltage)) if t.driven else "",
    }
    text = RELATION
    for key, value in values.items():
        text = text.replace(f"@{key}", value)
    return text.replace("ctl_", f"{name}_").replace("CTL_", f"{name.upper()}_")


def build_relation(name: str, folder: Path) -> Path:
    """Compile it with the design's own files."""
    require("gcc")
    (folder / "relation.c").write_text(relation(name), encoding="utf-8")
    files = ["relation.c", f"{name}.c", f"{name}_parts.c"]
    done = run(["gcc", *EXACT, "-O1", *files, "-lm", "-o", "relation"], folder)
    assert done.returncode == 0, done.stderr[:2000]
    return folder / "relation"


@pytest.mark.slow_for("halbach")
@pytest.mark.parametrize(
    "name", ["halbach", *(pytest.param(n, marks=pytest.mark.slow) for n in ("robust", "tubular_pid"))]
)
def test_no_step_leaves_the_relation(name: str, tmp_path: Path) -> None:
    """A monitor that acts lands it or turns it off; a fault waits for an edge of acknowledge without stop and STO."""
    program = build_relation(name, write_folder(name, "double", tmp_path))
    done = run([str(program)], tmp_path)
    assert done.stdout.startswith("0 wrong of "), done.stdout
    assert int(done.stdout.split()[-1]) > 1e6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("(sup->acknowledged == 0) && is_free(request)", "(sup->acknowledged == 0)"),
        ("(request->start != 0) && (sup->started == 0)", "(request->start != 0)"),
        ("SENSORS, EVENT_LAND, HALBACH_OFF", "SENSORS, EVENT_LAND, HALBACH_LIFT"),
        ("HOLD, EVENT_FAULT, HALBACH_FAULT", "HOLD, EVENT_FAULT, HALBACH_HOLD"),
        ("(row->reaction > strongest)", "(row->reaction < strongest)"),
        ("sup->enable = is_flying(sup->state);", "sup->enable = 1;"),
    ],
)
def test_it_finds_a_wrong_relation(old: str, new: str, tmp_path: Path) -> None:
    folder = write_folder("halbach", "double", tmp_path)
    path = folder / "halbach_supervisor.c"
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    assert run([str(build_relation("halbach", folder))], folder).returncode == 1


@pytest.mark.slow
def test_stops_are_heard_at_once_in_every_state_in_which_gates_may_be_on() -> None:
    for name in ("halbach", "robust"):
        for key in ("STOP", "STO"):
            (row,) = [row for row in monitors_of(target(name, "double")) if row.key == key]
            assert (row.samples, row.reaction, row.states) == (1, "FAULT", IN_USE)
            assert set(IN_FLIGHT) < set(row.states)

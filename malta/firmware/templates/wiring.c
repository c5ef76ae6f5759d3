/* The wiring: what sensors and currents answer to small commands while the machine rests, and what swaps, inversions and
   place along the stroke would explain it. Answers are whitened: over the noise of their mean, and over what the curved
   way of a mover that slides on its bearing adds to it. */
#define TESTS {{ tests }}
#define COMMANDS {{ commands }}
#define PLACES {{ answer_places }}
#define SWAPS {{ swaps | length }}
#define LATE {{ late }} /* samples by which currents follow */
#define COLUMNS {{ tests + 1 }} /* of a reading: its answers, and where it rests */
#define FIRST_PLACE (1 + 1 + SWAPS + COMMANDS) /* hypotheses: none, all inverted, swaps, single ones inverted, places */
#define HYPOTHESES (FIRST_PLACE + {{ "PLACES" if answer_places > 1 else "0" }})

static const {{ name }}_real patterns[TESTS][COMMANDS] = {
{{ pattern_rows }}
};
static const int32_t lengths[TESTS] = { {{ lengths }} };

/* What a hypothesis says: which coil each command drives, which way, and where the machine is. */
typedef struct {
  int32_t coil[COMMANDS];
  {{ name }}_real sign[COMMANDS];
  {{ name }}_real at; /* in places */
} guess;

/* The sign of Thue and Morse: that of the section, by whether its number has an odd number of ones. */
static {{ name }}_real wave_of(int32_t test, int32_t moment) {
  static const int32_t sections[TESTS] = { {{ sections }} };
  int32_t part = moment / sections[test];
  {{ name }}_real sign = {{ one }};
  while (part > 0) {
    sign = ((part % 2) == 1) ? -sign : sign;
    part = part / 2;
  }
  return sign;
}

/* One sample of a test: the answers so far. */
static void listen({{ name }}_supervisor *sup, const {{ name }}_inputs *in) {
  const int32_t test = sup->test;
  const int32_t answered = sup->moment - LATE;
  const {{ name }}_real wave = (answered >= 0) ? wave_of(test, answered) : {{ zero }};
  const {{ name }}_real share = wave / ({{ name }}_real)lengths[test];
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if (is_within(in->y[k], range[k]) == 1) {
      const {{ name }}_real way = in->y[k] - sup->rest[k];
      sup->answer[(test * OUTPUTS) + k] = sup->answer[(test * OUTPUTS) + k] + (share * way);
      sup->wander[(test * OUTPUTS) + k] = sup->wander[(test * OUTPUTS) + k] + (size_of(way) / ({{ name }}_real)lengths[test]);
    }
  }
{% if currents %}
  for (k = 0; k < {{ currents }}; k++) {
    if (is_within(in->i[k], {{ most }}) == 1) {
      sup->carried[(test * {{ currents }}) + k] = sup->carried[(test * {{ currents }}) + k] + (share * in->i[k]);
    }
  }
{% endif %}
  sup->moment++;
  if (sup->moment == (lengths[test] + LATE)) {
    sup->moment = 0;
    sup->test++;
  }
}

/* What is commanded beside rest at a sample of a test. */
static void push(const {{ name }}_supervisor *sup, {{ name }}_outputs *out) {
  if ((sup->test < TESTS) && (sup->moment < lengths[sup->test])) {
    const {{ name }}_real wave = wave_of(sup->test, sup->moment);
    int32_t k;
    for (k = 0; k < COMMANDS; k++) {
      out->{{ commanded }}[k] = out->{{ commanded }}[k] + (wave * patterns[sup->test][k]);
    }
  }
}

/* The place that is read, in places of the table. */
static {{ name }}_real place_read(const {{ name }}_supervisor *sup) {
{% if answer_places > 1 %}
  const {{ name }}_real along = (sup->rest[{{ stroke_output }}] - ({{ first_answer }})) / {{ answers_apart }};
  const {{ name }}_real most = {{ last_place }};
  const {{ name }}_real above = (along > {{ zero }}) ? along : {{ zero }};
  return (above < most) ? above : most;
{% else %}
  (void)sup;
  return {{ zero }};
{% endif %}
}

/* The accepted hypothesis, and one more step of it. */
static void guess_of(const {{ name }}_supervisor *sup, int32_t step, guess *g) {
  static const int32_t swaps[SWAPS][3] = { {{ swap_rows }} }; /* two first commands, and how many follow */
  int32_t k;
  for (k = 0; k < COMMANDS; k++) {
    g->coil[k] = sup->coil[k];
    g->sign[k] = ({{ name }}_real)sup->turned[k];
    if ((step == 1) || (step == (2 + SWAPS + k))) {
      g->sign[k] = -g->sign[k];
    }
  }
  g->at = sup->at;
  if ((step >= 2) && (step < (2 + SWAPS))) {
    const int32_t *const swap = swaps[step - 2];
    for (k = 0; k < swap[2]; k++) {
      const int32_t coil = g->coil[swap[0] + k];
      const {{ name }}_real sign = g->sign[swap[0] + k];
      g->coil[swap[0] + k] = g->coil[swap[1] + k];
      g->sign[swap[0] + k] = g->sign[swap[1] + k];
      g->coil[swap[1] + k] = coil;
      g->sign[swap[1] + k] = sign;
    }
  }
  if (step >= FIRST_PLACE) {
    const int32_t place = step - FIRST_PLACE;
    g->at = ({{ name }}_real)place;
  }
}

/* What each output would answer, and where it would rest. */
static void foresee(const {{ name }}_supervisor *sup, const guess *g, {{ name }}_real expected[OUTPUTS][COLUMNS]) {
  static const {{ name }}_real stretches[TESTS][OUTPUTS] = {
{{ stretch_rows }}
  };
  static const {{ name }}_real answers[PLACES][OUTPUTS][COMMANDS] = { /* to single commands of size 1 */
{{ answer_rows }}
  };
  static const {{ name }}_real places_of_rest[PLACES][OUTPUTS] = {
{{ rest_rows }}
  };
  const int32_t whole = (int32_t)g->at;
{% if answer_places > 1 %}
  const int32_t low = (whole < {{ answer_places - 1 }}) ? whole : {{ answer_places - 2 }};
  const int32_t high = low + 1;
{% else %}
  const int32_t low = whole;
  const int32_t high = whole;
{% endif %}
  const {{ name }}_real share = g->at - ({{ name }}_real)low;
  int32_t l;
  for (l = 0; l < OUTPUTS; l++) {
    {{ name }}_real single[COMMANDS];
    int32_t k;
    int32_t j;
    for (k = 0; k < COMMANDS; k++) {
      const {{ name }}_real here = answers[low][l][g->coil[k]];
      const {{ name }}_real there = answers[high][l][g->coil[k]];
      single[k] = g->sign[k] * (here + (share * (there - here)));
    }
    for (j = 0; j < TESTS; j++) {
      const {{ name }}_real scale = sup->scale[(j < COMMANDS) ? 0 : 1] * stretches[j][l];
      {{ name }}_real sum = {{ zero }};
      for (k = 0; k < COMMANDS; k++) {
        sum = sum + (patterns[j][k] * single[k]);
      }
      expected[l][j] = scale * sum;
    }
    expected[l][TESTS] = places_of_rest[low][l] + (share * (places_of_rest[high][l] - places_of_rest[low][l]));
  }
}

/* The deviation of each number of a reading. */
static void deviate(const {{ name }}_supervisor *sup, int32_t k, {{ name }}_real deviation[COLUMNS]) {
  static const {{ name }}_real root_lengths[TESTS] = { {{ roots }} };
  static const {{ name }}_real ways[OUTPUTS] = { {{ ways }} };
  static const {{ name }}_real noises[OUTPUTS] = { {{ noises }} };
  const {{ name }}_real own = sup->noise[k] / {{ mean_jump }};
  const {{ name }}_real noise = (own > noises[k]) ? own : noises[k];
  int32_t j;
  for (j = 0; j < TESTS; j++) {
    {{ name }}_real way = {{ zero }};
    int32_t l;
    for (l = 0; l < OUTPUTS; l++) {
      const {{ name }}_real moved = {{ "(l == %d) ? %s : "|format(stroke_output, zero) if stroke_output >= 0 }}size_of(sup->answer[(j * OUTPUTS) + l]);
      way = (moved > way) ? moved : way;
    }
    const {{ name }}_real wander = sup->wander[(j * OUTPUTS) + k] - noise;
    deviation[j] = (noise / root_lengths[j]) + (({{ eight }} * (way * way)) / ways[k]);
    if (wander > {{ zero }}) {
      deviation[j] = deviation[j] + ({{ leaks }} * wander);
    }
  }
  deviation[TESTS] = {{ rest_share }} * ways[k];
}

/* How a reading fits an output: correlation, squared, with its sign; and their ratio. No noise, as far as it is known. */
static {{ name }}_real fit_of(const {{ name }}_real seen[COLUMNS], const {{ name }}_real deviation[COLUMNS],
                              const {{ name }}_real expected[COLUMNS], int32_t columns, {{ name }}_real *ratio) {
  {{ name }}_real both = {{ zero }};
  {{ name }}_real own = {{ zero }};
  {{ name }}_real all = -({{ name }}_real)columns;
  int32_t j;
  for (j = 0; j < columns; j++) {
    const {{ name }}_real a = seen[j] / deviation[j];
    const {{ name }}_real b = expected[j] / deviation[j];
    both = both + (a * b);
    own = own + (b * b);
    all = all + (a * a);
  }
  *ratio = {{ zero }};
  if (own > {{ zero }}) {
    *ratio = both / own;
  }
  all = (all > ({{ least_seen }} * own)) ? all : ({{ least_seen }} * own);
  {{ name }}_real fit = {{ zero }};
  if ((own * all) > {{ zero }}) {
    fit = (both * both) / (own * all);
  }
  fit = (fit < {{ one }}) ? fit : {{ one }};
  return (both < {{ zero }}) ? -fit : fit;
}

/* Which output each reading shows under a hypothesis; how badly all that fits. The mistakes of readings are added. */
static {{ name }}_real judge_readings(const {{ name }}_supervisor *sup, const guess *g, int32_t shows[OUTPUTS], {{ name }}_real gain[OUTPUTS],
                                     int32_t *mistakes) {
  {{ name }}_real expected[OUTPUTS][COLUMNS];
  {{ name }}_real misfit = {{ zero }};
  int32_t k;
  foresee(sup, g, expected);
  for (k = 0; k < OUTPUTS; k++) {
    {{ name }}_real seen[COLUMNS];
    {{ name }}_real deviation[COLUMNS];
    {{ name }}_real best = {{ zero }};
    {{ name }}_real own = {{ zero }};
    {{ name }}_real ratio;
    int32_t j;
    int32_t l;
    deviate(sup, k, deviation);
    for (j = 0; j < TESTS; j++) {
      seen[j] = sup->answer[(j * OUTPUTS) + k];
    }
    seen[TESTS] = sup->rest[k];
    shows[k] = 0;
    gain[k] = {{ zero }};
    for (l = 0; l < OUTPUTS; l++) {
      int32_t columns = COLUMNS;
{% if stroke_output >= 0 %}
      if (l == {{ stroke_output }}) {
        columns = TESTS; /* a stroke may rest anywhere */
      }
{% endif %}
      const {{ name }}_real fit = fit_of(seen, deviation, expected[l], columns, &ratio);
      const bool named = size_of(ratio) > {{ least_gain }};
      const {{ name }}_real preferred = size_of(fit) + ((l == k) ? {{ own_first }} : {{ zero }});
      if (named && (preferred > best)) {
        best = preferred;
        own = size_of(fit);
        shows[k] = (fit < {{ zero }}) ? -(l + 1) : (l + 1);
        gain[k] = size_of(ratio);
      }
    }
    if (best < {{ least_fit }}) {
      shows[k] = 0;
      gain[k] = {{ zero }};
    }
    misfit = misfit + ((shows[k] == 0) ? {{ mistake }} : ({{ one }} - own));
    if ((shows[k] != (k + 1)) || (gain[k] < {{ low_gain }}) || (gain[k] > {{ high_gain }})) {
      *mistakes = *mistakes + 1;
    }
  }
  return misfit;
}

{% if currents %}
/* What a current sensor would read, of the test of a single command: at its coil, or at its half-bridge. */
static {{ name }}_real current_of(const {{ name }}_supervisor *sup, const guess *g, int32_t sensor, int32_t test, bool at_bridge) {
  static const {{ name }}_real carries[{{ currents }}][COMMANDS] = { /* currents, likewise */
{{ current_rows }}
  };
  const int32_t coil = at_bridge ? g->coil[sensor] : sensor;
  return sup->scale[0] * (patterns[test][test] * (g->sign[test] * carries[coil][g->coil[test]]));
}

/* How badly the readings of the currents fit, as a share of them. */
static {{ name }}_real misfit_of_currents(const {{ name }}_supervisor *sup, const guess *g, bool at_bridge) {
  {{ name }}_real off = {{ zero }};
  {{ name }}_real all = {{ zero }};
  int32_t i;
  for (i = 0; i < {{ currents }}; i++) {
    int32_t j;
    for (j = 0; j < COMMANDS; j++) {
      const {{ name }}_real wanted = current_of(sup, g, i, j, at_bridge);
      const {{ name }}_real apart = sup->carried[(j * {{ currents }}) + i] - wanted;
      off = off + (apart * apart);
      all = all + (wanted * wanted);
    }
  }
  if (all > {{ zero }}) {
    off = off / all;
  }
  return off;
}

/* The same, whether cables of coils are swapped, or wires of half-bridges. */
static {{ name }}_real judge_currents(const {{ name }}_supervisor *sup, const guess *g) {
  const {{ name }}_real coils = misfit_of_currents(sup, g, false);
  const {{ name }}_real bridges = misfit_of_currents(sup, g, true);
  return (coils < bridges) ? coils : bridges;
}

/* Which current a sensor reads. */
static int32_t read_by(const {{ name }}_supervisor *sup, const guess *g, int32_t sensor) {
  const bool at_bridge = sup->cables == 1;
  int32_t found = 0;
  {{ name }}_real best = {{ zero }};
  int32_t i;
  for (i = 0; i < {{ currents }}; i++) {
    {{ name }}_real both = {{ zero }};
    {{ name }}_real all = {{ zero }};
    int32_t j;
    for (j = 0; j < COMMANDS; j++) {
      const {{ name }}_real wanted = current_of(sup, g, i, j, at_bridge);
      both = both + (wanted * sup->carried[(j * {{ currents }}) + sensor]);
      all = all + (wanted * wanted);
    }
    if ((size_of(both) > best) && (size_of(both) > ({{ half }} * all))) {
      best = size_of(both);
      found = (both < {{ zero }}) ? -(i + 1) : (i + 1);
    }
  }
  return found;
}

/* The currents that flowed over those expected, in short and in long tests. */
static void scale_currents({{ name }}_supervisor *sup) {
  static const {{ name }}_real usual[2] = { {{ current_squares }} };
  {{ name }}_real sum[2] = { {{ zero }}, {{ zero }} };
  int32_t j;
  int32_t k;
  for (j = 0; j < TESTS; j++) {
    for (k = 0; k < {{ currents }}; k++) {
      const {{ name }}_real i = sup->carried[(j * {{ currents }}) + k];
      sum[(j < COMMANDS) ? 0 : 1] = sum[(j < COMMANDS) ? 0 : 1] + (i * i);
    }
  }
  for (k = 0; k < 2; k++) {
    sup->scale[k] = (usual[k] > {{ zero }}) ? {{ name }}_root(sum[k] / usual[k]) : {{ one }};
  }
}

{% endif %}
/* A hypothesis on trial; the best one is kept, and one that fits as well. */
static void try_guess({{ name }}_supervisor *sup, int32_t step) {
  int32_t shows[OUTPUTS];
  {{ name }}_real gain[OUTPUTS];
  int32_t mistakes = 0;
  guess g;
  guess_of(sup, step, &g);
  if (step != 0) {
    mistakes = 1;
  }
  {{ name }}_real misfit = judge_readings(sup, &g, shows, gain, &mistakes);
{% if currents %}
  misfit = misfit + ({{ of_currents }} * judge_currents(sup, &g));
{% endif %}
  const {{ name }}_real whole = misfit + ({{ mistake }} * ({{ name }}_real)mistakes);
  if (step == 0) {
    int32_t k;
    sup->best = 0;
    sup->least = whole;
    sup->misfit = misfit;
    sup->rival = -1;
    for (k = 0; k < OUTPUTS; k++) {
      sup->shows[k] = shows[k];
      sup->gain[k] = gain[k];
    }
  } else if (whole < sup->least) {
    /* places beside each other are no rivals */
    sup->rival = ((size_of(misfit - sup->misfit) < {{ tie }}) && ((step < FIRST_PLACE) || (sup->best < FIRST_PLACE))) ? sup->best : -1;
    sup->best = step;
    sup->least = whole;
    sup->misfit = misfit;
  } else if ((size_of(misfit - sup->misfit) < {{ tie }}) && ((whole - sup->least) < {{ tie }}) && (sup->best != 0)) {
    sup->rival = ((step < FIRST_PLACE) || (sup->best < FIRST_PLACE)) ? step : sup->rival;
  } else {
    /* worse */
  }
}

/* A step of a hypothesis is taken for true. */
static void accept({{ name }}_supervisor *sup) {
  guess g;
  int32_t k;
  guess_of(sup, sup->best, &g);
  if (sup->level == 0) {
    sup->doubt = sup->rival;
    for (k = 0; k < OUTPUTS; k++) {
      sup->shows_else[k] = sup->shows[k];
    }
  }
  for (k = 0; k < COMMANDS; k++) {
    sup->coil[k] = g.coil[k];
    sup->turned[k] = 1;
    if (g.sign[k] < {{ zero }}) {
      sup->turned[k] = -1;
    }
  }
  sup->at = g.at;
}

/* Whether all that was found is as it should be. */
static bool is_wired(const {{ name }}_supervisor *sup) {
  bool right = (sup->scale[0] > {{ low_gain }}) && (sup->scale[0] < {{ high_gain }});
  int32_t k;
  right = right && (sup->scale[1] > {{ low_gain }}) && (sup->scale[1] < {{ high_gain }});
  for (k = 0; k < OUTPUTS; k++) {
    right = right && (sup->shows[k] == (k + 1)) && (sup->gain[k] > {{ low_gain }}) && (sup->gain[k] < {{ high_gain }});
  }
  for (k = 0; k < COMMANDS; k++) {
    right = right && (sup->coil[k] == k) && (sup->turned[k] == 1);
  }
{% if currents %}
  for (k = 0; k < {{ currents }}; k++) {
    right = right && (sup->reads[k] == (k + 1));
  }
{% endif %}
  return right && (is_within(sup->at - sup->read, {{ near_place }}) == 1);
}

/* Before the first test. */
static void begin_wiring({{ name }}_supervisor *sup) {
  int32_t k;
  sup->wired = 0;
  sup->cables = 0;
  sup->test = 0;
  sup->moment = 0;
  sup->tried = 0;
  sup->level = 0;
  sup->rival = -1;
  sup->doubt = -1;
  sup->scale[0] = {{ one }};
  sup->scale[1] = {{ one }};
  sup->read = place_read(sup);
  sup->at = sup->read;
  for (k = 0; k < COMMANDS; k++) {
    sup->coil[k] = k;
    sup->turned[k] = 1;
  }
  for (k = 0; k < (TESTS * OUTPUTS); k++) {
    sup->answer[k] = {{ zero }};
    sup->wander[k] = {{ zero }};
  }
  for (k = 0; k < OUTPUTS; k++) {
    sup->shows[k] = 0;
  }
{% if currents %}
  for (k = 0; k < (TESTS * {{ currents }}); k++) {
    sup->carried[k] = {{ zero }};
  }
{% endif %}
}

/* One sample: of a test, or of the search for what explains the answers, one hypothesis a sample. */
static void wire({{ name }}_supervisor *sup, const {{ name }}_inputs *in) {
  if (sup->test < TESTS) {
    listen(sup, in);
{% if currents %}
    if (sup->test == TESTS) {
      scale_currents(sup);
    }
{% endif %}
  } else if (sup->tried < HYPOTHESES) {
    try_guess(sup, sup->tried);
    sup->tried++;
  } else if ((sup->best != 0) && (sup->level < {{ levels }})) {
    accept(sup);
    sup->level++;
    sup->tried = 0;
{% if currents %}
  } else if ((sup->tried - HYPOTHESES) < {{ currents }}) {
    guess g;
    guess_of(sup, 0, &g);
    if (misfit_of_currents(sup, &g, true) < misfit_of_currents(sup, &g, false)) {
      sup->cables = 1;
    }
    sup->reads[sup->tried - HYPOTHESES] = read_by(sup, &g, sup->tried - HYPOTHESES);
    sup->tried++;
{% endif %}
  } else {
    sup->wired = is_wired(sup) ? 1 : -1;
  }
}


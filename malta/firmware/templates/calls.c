/* The functions of {{ name }}.h beside the step: what they accept and refuse, and the pieces of a step. */
static int32_t expect_answer(const char *what, int32_t found, int32_t expected) {
  if (found != expected) {
    (void)printf("%s: answers %ld, expected %ld\n", what, (long)found, (long)expected);
  }
  return (found == expected) ? 0 : 1;
}

static int32_t try_tables(void) {
  static const {{ name }}_real z[2] = { {{ zero }}, {{ zero }} };
  static const {{ name }}_real v0[{{ 2 * forces }}] = { {{ ([zero] * (2 * forces)) | join(", ") }} };
  {{ name }}_state s;
  {{ name }}_reference r;
  int32_t failed = 0;
  int32_t k;
  {{ name }}_init(&s);
  r = s.reference;
  r.p[0] = ({{ name }}_real)NAN;
  failed += expect_answer("a reference that is no number", {{ name }}_set_reference(&s, &r), 0);
  failed += expect_answer("a table of one point", {{ name }}_set_v0_table(&s, 1, z, v0), 0);
  failed += expect_answer("a table of one place", {{ name }}_set_v0_table(&s, 2, z, v0), 0);
  failed += expect_answer("the own table", {{ name }}_set_v0_table(&s, s.points, s.z, s.v0), 1);
  for (k = 0; k < {{ outputs }}; k++) {
    s.e[k] = {{ one }};
  }
  {{ name }}_reset_integrators(&s);
  for (k = 0; k < {{ outputs }}; k++) {
    failed += (s.e[k] == {{ zero }}) ? 0 : 1;
  }
  return failed;
}
{% if stroke %}

/* A stroke in each profile from end to end: it ends in its samples, where it shall. */
static int32_t try_strokes(uint32_t *total) {
  int32_t failed = 0;
  int32_t profile;
  for (profile = {{ NAME }}_LOGISTIC; profile <= {{ NAME }}_QUINTIC; profile++) {
    const {{ name }}_real rise = {{ stroke_samples }} * {{ NAME }}_SAMPLE_TIME;
    {{ name }}_stroke stroke;
    {{ name }}_reference r;
    int32_t samples = 0;
    failed += expect_answer("a stroke beyond its limits", {{ name }}_start_stroke(&stroke, profile, {{ zero }}, {{ stroke_beyond }}, rise), 0);
    failed += expect_answer("a stroke", {{ name }}_start_stroke(&stroke, profile, -({{ stroke_end }}), {{ stroke_end }}, rise), 1);
    while (({{ name }}_follow_stroke(&stroke, &r) == 1) && (samples < 1000)) {
      *total = add_bits(*total, r.p[{{ stroke_output }}]);
      samples++;
    }
    if (!((r.p[{{ stroke_output }}] > {{ stroke_near }}) && (r.p[{{ stroke_output }}] < {{ stroke_over }}))) {
      (void)printf("a stroke of profile %ld ends elsewhere\n", (long)profile);
      failed++;
    }
  }
  return failed;
}
{% endif %}

/* Numbers from -1 to 1 times a scale, the same on every processor. */
static void draw(uint32_t *seed, {{ name }}_real values[], int32_t count) {
  int32_t k;
  for (k = 0; k < count; k++) {
    int32_t whole;
    *seed = (*seed * 1664525u) + 1013904223u;
    whole = (int32_t)(uint32_t)(*seed >> 16) - 32768;
    values[k] = ({{ name }}_real)whole * {{ piece_scale }};
  }
}

/* Each piece with drawn numbers, against the checksums of what its expressions give. */
static int32_t try_pieces(uint32_t *total) {
  static const uint32_t expected[{{ pieces|length }}] = {
{{ piece_sums }}
  };
  static const char *const names[{{ pieces|length }}] = {
{% for piece in pieces %}
    "{{ piece.name }}"{{ "," if not loop.last }}
{% endfor %}
  };
  static {{ name }}_real given[{{ most_given }}];
  static {{ name }}_real found[{{ most_found }}];
{% for piece in pieces if piece.records %}
  static {{ name }}_{{ piece.name }}_given {{ piece.name }}_given;
  static {{ name }}_{{ piece.name }}_found {{ piece.name }}_found;
{% endfor %}
  uint32_t seed = 1u;
  int32_t failed = 0;
  int32_t k;
  for (k = 0; k < {{ pieces|length }}; k++) {
    int32_t results = 0;
    uint32_t sum;
    draw(&seed, given, {{ most_given }});
    switch (k) {
{% for piece in pieces %}
    case {{ loop.index0 }}:
{% for place in piece.times %}
      given[{{ place }}] = {{ piece_time }};
{% endfor %}
{% if piece.records %}
      (void)memcpy(&{{ piece.name }}_given, given, sizeof {{ piece.name }}_given);
      {{ piece.call }};
      (void)memcpy(found, &{{ piece.name }}_found, sizeof {{ piece.name }}_found);
{% else %}
      {{ piece.call }};
{% endif %}
      results = {{ piece.results }};
      break;
{% endfor %}
    default:
      break;
    }
    sum = add_all({{ fnv_start }}u, found, results);
    if (sum != expected[k]) {
      (void)printf("%s: differs\n", names[k]);
      failed++;
    }
    *total = (*total ^ sum) * {{ fnv_factor }}u;
  }
  return failed;
}

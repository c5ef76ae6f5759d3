/* What a supervisor in operation makes of requested references, one a sample, that begin with a motion within the limits, or at rest. */
void {{ name }}_limit_references(int32_t count, const {{ name }}_real *asked, {{ name }}_real *found) {
  static const {{ name }}_request nothing;
  {{ name }}_state s;
  {{ name }}_supervisor sup;
  int32_t sample;
  int32_t k;
  {{ name }}_init(&s);
  {{ name }}_supervisor_init(&sup);
  sup.state = {{ NAME }}_OPERATE;
  for (k = 0; k < OUTPUTS; k++) {
    const int32_t here = is_within(asked[k], farthest[k]);
    const int32_t slow = is_within(asked[OUTPUTS + k], fastest[k]);
    const int32_t even = is_within(asked[(2 * OUTPUTS) + k], steepest[k]);
    if ((here + slow + even) == 3) {
      const {{ name }}_real h = {{ NAME }}_SAMPLE_TIME; /* a sample before */
      const {{ name }}_real bend = h * asked[(2 * OUTPUTS) + k];
      s.reference.dp[k] = asked[OUTPUTS + k] - bend;
      s.reference.p[k] = asked[k] - (0.5 * h * (asked[OUTPUTS + k] + s.reference.dp[k]));
    } else {
      s.reference.p[k] = between(-farthest[k], asked[k], farthest[k]);
    }
    sup.asked[k] = s.reference.p[k];
    sup.asked_rate[k] = s.reference.dp[k];
    sup.followed = 1;
  }
  for (sample = 0; sample < count; sample++) {
    const {{ name }}_real *now = &asked[(size_t)sample * 3 * OUTPUTS];
    {{ name }}_real *row = &found[(size_t)sample * 3 * OUTPUTS];
    {{ name }}_request request = nothing;
    for (k = 0; k < OUTPUTS; k++) {
      request.reference.p[k] = now[k];
      request.reference.dp[k] = now[OUTPUTS + k];
      request.reference.ddp[k] = now[(2 * OUTPUTS) + k];
    }
    remember(&sup, &request);
    guide(&sup, &s, &request);
    for (k = 0; k < OUTPUTS; k++) {
      row[k] = s.reference.p[k];
      row[OUTPUTS + k] = s.reference.dp[k];
      row[(2 * OUTPUTS) + k] = s.reference.ddp[k];
    }
  }
}

/* Flights of the supervised controller with its machine from any state: which of them end at rest at the centre. */

/* found[k] is 1 where the machine that begins at x[k] without current, whose readings have the rates dp[k], is at rest in
   operation after so many samples, having met nothing and with its gates on all the time. */
void {{ name }}_reenter(int32_t count, const double *x, const double *dp, const double *par, double noise, double seed,
                        int32_t samples, double *found) {
  static const double settled[{{ outputs }}] = { {{ settled }} };
  static const {{ name }}_real rest[{{ outputs }}];
  static const {{ name }}_inputs no_inputs;
  static const {{ name }}_request nothing;
{% if wrench %}
  static const double none[{{ wrench }}];
{% endif %}
  int32_t flight;
{% if not noises %}
  (void)noise;
  (void)seed;
{% endif %}
  for (flight = 0; flight < count; flight++) {
    {{ plant }}_state machine;
    {{ plant }}_readings r;
    {{ name }}_state s;
    {{ name }}_supervisor sup;
    {{ name }}_inputs in = no_inputs;
    {{ name }}_outputs out;
    int32_t well = 1;
    int32_t sample;
    int32_t k;
{% if volts %}
    double volts[{{ volts }}];
{% endif %}
    {{ plant }}_start(&machine, par, &x[flight * {{ states }}], 1.0{% if volts %}, volts{% endif %});
    {{ name }}_init(&s);
    for (sample = 0; (sample < samples) && (well == 1); sample++) {
      double command[{{ held }}];
      {{ plant }}_look(&machine, par{% if noises %}, noise, seed{% endif %}, &r);
      for (k = 0; k < {{ outputs }}; k++) {
        in.y[k] = ({{ name }}_real)r.y[k];
        in.y_valid[k] = 1;
      }
{% if driven %}
      for (k = 0; k < {{ currents }}; k++) {
        in.i[k] = ({{ name }}_real)r.i[k];
        in.i_valid[k] = 1;
      }
      in.link[0] = ({{ name }}_real)r.link[0];
{% endif %}
      if (sample == 0) {
        for (k = 0; k < {{ outputs }}; k++) {
          s.reference.p[k] = in.y[k];
          s.reference.dp[k] = ({{ name }}_real)dp[(flight * {{ outputs }}) + k];
        }
        {{ name }}_start(&s);
        {{ name }}_supervisor_take_over(&sup, rest);
      }
      {{ name }}_supervisor_step(&sup, &s, &in, &nothing, &out);
      for (k = 0; k < {{ contacts }}; k++) {
        well = (r.contact[k] < 1.0) ? well : 0;
      }
      well = ((sup.state == {{ NAME }}_OPERATE) || (sup.state == {{ NAME }}_HOLD)) ? well : 0;
      if (sample >= (samples - {{ calm }})) {
        for (k = 0; k < {{ outputs }}; k++) {
          well = ((r.p[k] <= settled[k]) && (r.p[k] >= -settled[k])) ? well : 0;
        }
        well = (sup.state == {{ NAME }}_OPERATE) ? well : 0;
      }
      for (k = 0; k < {{ held }}; k++) {
        command[k] = (double)out.{{ command }}[k];
      }
      {{ plant }}_step(&machine, par, command, sup.enable{% if wrench %}, none{% endif %}{% if delay %}, 1{% endif %});
    }
    found[flight] = (double)well;
  }
}

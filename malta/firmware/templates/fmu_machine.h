/* A {{ machine }} between two samples, which are {{ period }} apart: see {{ name }}.c. Units are SI. */
#ifndef {{ NAME }}_H
#define {{ NAME }}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef double {{ name }}_real;

typedef struct {
  {{ name }}_real state[{{ state }}];
{% if delay %}
  {{ name }}_real under_way[{{ delay * held }}]; /* commands that do not act yet */
{% endif %}
  {{ name }}_real samples; /* since the start */
  {{ name }}_real substeps;
} {{ name }}_state;

typedef struct {
{% for f in reads %}
  {{ name }}_real {{ f.name }}[{{ f.size }}]; /* {{ f.meaning }} */
{% endfor %}
} {{ name }}_readings;

/* The machine's parameters are par[{{ parameters }}] in each call.

   At x[{{ states }}], with the currents that make v0 there, or with none where `cold` is 1. Also what integrals of current
   loops hold then. */
void {{ name }}_start({{ name }}_state *s, const {{ name }}_real par[{{ parameters }}], const {{ name }}_real x[{{ states }}], {{ name }}_real cold{% if volts %}, {{ name }}_real u_integral[{{ volts }}]{% endif %});

/* One sample{% if delay %}; the command acts {{ delay }} later where `late` is not 0, else at once{% endif %}. Where `gates` is 0 all switches
   are open, whatever is commanded: no current flows. */
void {{ name }}_step({{ name }}_state *s, const {{ name }}_real par[{{ parameters }}], const {{ name }}_real command[{{ held }}], int32_t gates{% if wrench %}, const {{ name }}_real w[{{ wrench }}]{% endif %}{% if delay %}, int32_t late{% endif %});

/* What is known of the machine now{% if noises %}, read with so many times the noise of its sensors; a seed gives the noise of simulations{% endif %}. */
void {{ name }}_look(const {{ name }}_state *s, const {{ name }}_real par[{{ parameters }}]{% if noises %}, {{ name }}_real noise, {{ name }}_real seed{% endif %}, {{ name }}_readings *r);
{% for text in declarations %}

{{ text }};
{% endfor %}

#ifdef __cplusplus
}
#endif
#endif

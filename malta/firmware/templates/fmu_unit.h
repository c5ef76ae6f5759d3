/* {{ title }}: variables of the unit by value reference, and what a sample does with them. */
#ifndef FMU_UNIT_H
#define FMU_UNIT_H

#include <stddef.h>
#include <stdint.h>

{% if controller %}
#include "{{ name }}{{ "_supervisor" if supervised }}.h"
{% endif %}
{% if machine %}
#include "{{ plant }}.h"
{% endif %}

#define UNIT_TOKEN "{{ token }}"
#define UNIT_VARIABLES {{ variables|length }}
#define UNIT_SAMPLE_TIME {{ sample_time }} /* s */

/* What a call ends with; the numbers are those of fmi2Status and fmi3Status. */
enum { UNIT_OK = 0, UNIT_WARNING = 1, UNIT_ERROR = 3 };

/* Before the initialization, in it, between steps, and after the end. */
enum { UNIT_NEW, UNIT_INITIAL, UNIT_RUNNING, UNIT_ENDED };

/* All that a unit remembers. */
typedef struct {
  double value[UNIT_VARIABLES]; /* value[0]: time, s */
  double held[UNIT_VARIABLES];  /* inputs at the beginning of a sample that is under way */
  double share;                 /* of this sample that is over */
{% if controller %}
  {{ name }}_state controller;
{% if tunable %}
  {{ name }}_parameters parameters; /* of the controller */
{% endif %}
{% if supervised %}
  {{ name }}_supervisor supervisor;
{% endif %}
{% endif %}
{% if machine %}
  {{ plant }}_state machine;
{% endif %}
  int32_t phase;
  int32_t changed; /* 1: the outputs of the initialization wait for a new start */
} unit_data;

void unit_reset(unit_data *u);

/* Each returns a status; what is wrong is in *message. */
int unit_begin(unit_data *u, double time, const char **message);
int unit_finish_beginning(unit_data *u, const char **message);
int unit_get(unit_data *u, uint32_t reference, double *value, const char **message);
int unit_set(unit_data *u, uint32_t reference, double value, const char **message);
int unit_advance(unit_data *u, double from, double step, const char **message);
int unit_end(unit_data *u, const char **message);

/* The state as bytes, and from bytes. */
size_t unit_bytes(void);
void unit_write(const unit_data *u, unsigned char *bytes);
int unit_read(unit_data *u, const unsigned char *bytes, const char **message);

#endif

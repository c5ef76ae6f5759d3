/* {{ title }}: what the law needs of a board, and what is checked of it before the first sample. Written by malta {{ version }}.

   A port fills in what its registers say, and calls {{ name }}_on_sample from its timer. {{ name }}_main.c has the rest: the supervisor,
   the parameters and the XCP slave. */
#ifndef {{ NAME }}_PORT_H
#define {{ NAME }}_PORT_H

#include "{{ name }}_supervisor.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Why a board is refused; the machine then stays off. */
#define {{ NAME }}_PORT_FITS 0
#define {{ NAME }}_PORT_TIMER 1    /* its period is off that of the law by more than 0.01 % */
#define {{ NAME }}_PORT_CURRENTS 2 /* currents up to {{ largest_current }} A cannot be read */
#define {{ NAME }}_PORT_PWM 3      /* steps of the duty cycles are coarser than {{ pwm_steps }} in a period */
#define {{ NAME }}_PORT_DELAY 4    /* voltages act later than {{ most_delay }} s after the readings, or not once a sample */

/* What a board is, as its registers say. */
typedef struct {
  {{ name }}_real period;     /* s, of the timer */
  {{ name }}_real current;    /* A, the largest that can be read; 0: the drive has the current loops */
  {{ name }}_real steps;      /* of a duty cycle, in a period of the PWM; 0: the same */
  {{ name }}_real delay;      /* s, from the readings to the middle of the voltages that they make */
} {{ name }}_board;

/* Of the board; called once, before the timer runs. Gates are off. */
void {{ name }}_port_begin({{ name }}_board *board);

/* Start the timer: {{ name }}_on_sample at each period, from its interrupt; missed: periods that went by without it. */
void {{ name }}_port_start(void);
void {{ name }}_on_sample(int32_t missed);

/* In a sample: readings in SI units with their validity, and what is asked for. */
void {{ name }}_port_read({{ name }}_inputs *in, {{ name }}_request *request);

/* In a sample: {{ last_output }}; enable: gates on, or all switches open. */
void {{ name }}_port_write(const {{ name }}_outputs *out, int32_t enable);

/* Beside: a byte of the serial line, -1 where there is none now, -2 where there was none for some milliseconds. */
int32_t {{ name }}_port_get(void);
void {{ name }}_port_put(uint32_t byte);

/* Why a board is refused. */
int32_t {{ name }}_port_check(const {{ name }}_board *board);

#ifdef __cplusplus
}
#endif
#endif

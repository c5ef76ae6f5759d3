/* {{ title }}: the pieces of a step, usable alone: see {{ name }}.h. Written by malta {{ version }}. */
#include "{{ name }}.h"

#include <stdbool.h>
{% include "exact.c" %}
{% if parts_fma %}

{% include "fused.c" %}
{% endif %}

{% include "arithmetic.c" %}
{% if parts_root %}
{% include "root.c" %}
{% endif %}
{% if parts_loops %}

{% include "apart.c" %}
{% endif %}

int32_t {{ name }}_parts_self_test(void) { return {{ name }}_is_exact(); }

{{ functions }}
{% if reads %}
static const {{ name }}_real own_table[{{ table_rows * table_columns * table_values }}] = {
{{ table_numbers }}
};

void {{ name }}_read_table(const {{ name }}_real table_at[{{ 2 * reads }}], {{ name }}_real table[{{ reads * table_values }}]) {
  int32_t k;
  for (k = 0; k < {{ reads }}; k++) {
    const {{ name }}_real u = table_at[2 * k];
    const {{ name }}_real v = table_at[(2 * k) + 1];
    const int32_t row = (u < {{ last_row }}) ? (int32_t)u : {{ table_rows - 2 }};
    const int32_t column = (v < {{ last_column }}) ? (int32_t)v : {{ table_columns - 2 }};
    const int32_t first = ((row * {{ table_columns }}) + column) * {{ table_values }};
    const int32_t next = first + {{ table_columns * table_values }};
    const {{ name }}_real a = u - ({{ name }}_real)row;
    const {{ name }}_real b = v - ({{ name }}_real)column;
    const {{ name }}_real before = {{ one }} - b;
    const {{ name }}_real above = {{ one }} - a;
    int32_t j;
    for (j = 0; j < {{ table_values }}; j++) {
      const {{ name }}_real low = (before * own_table[first + j]) + (b * own_table[first + {{ table_values }} + j]);
      const {{ name }}_real high = (before * own_table[next + j]) + (b * own_table[next + {{ table_values }} + j]);
      table[(k * {{ table_values }}) + j] = (above * low) + (a * high);
    }
  }
}
{% endif %}

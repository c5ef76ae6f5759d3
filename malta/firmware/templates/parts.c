/* {{ title }}: the pieces of a step, usable alone: see {{ name }}.h. Written by malta {{ version }}. */
#include "{{ name }}.h"

#include <stdbool.h>

#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif
{% if root %}
{% include "root.c" %}
{% endif %}

{{ functions }}

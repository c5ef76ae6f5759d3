#ifndef {{ NAME }}_ARITHMETIC
#define {{ NAME }}_ARITHMETIC
/* 1 where these operations are compiled as they are written: no macro tells of a compiler that changes their order, takes
   two for one, multiplies by reciprocals, or forgets small numbers, signs of zero and numbers that are none. What is given
   and what is found are volatile: a compiler knows neither. */
static int32_t {{ name }}_is_exact(void) {
  static const volatile {{ name }}_real given[{{ arithmetic.given | length }}] = { {{ arithmetic.given | join(", ") }} };
  static const {{ name }}_real expected[{{ arithmetic.expected | length }}] = { {{ arithmetic.expected | join(", ") }} };
  volatile {{ name }}_real found[{{ arithmetic.expected | length }}];
  const {{ name }}_real zero = given[0];
  const {{ name }}_real unit = given[1];
  const {{ name }}_real large = given[2];
  const {{ name }}_real odd = given[3];
  const {{ name }}_real square = given[4];
  const {{ name }}_real divisor = given[5];
  const {{ name }}_real small = given[6];
  const {{ name }}_real greatest = given[7];
  const {{ name }}_real quarter = given[8];
  const {{ name }}_real sum = large + unit;
  const {{ name }}_real product = odd * odd;
  const {{ name }}_real thrice = quarter + (quarter + quarter);
  const {{ name }}_real below = -zero;
  const {{ name }}_real above = below + {{ arithmetic.zero }};
  const {{ name }}_real inverse = unit / above;
  const {{ name }}_real smaller = small * {{ arithmetic.half }};
  const {{ name }}_real infinite = greatest * greatest;
  const {{ name }}_real none = infinite - infinite;
  int32_t exact = 1;
  int32_t k;
  found[0] = sum - large;
  found[1] = product - square;
  for (k = 0; k < {{ arithmetic.dividends }}; k++) {
    const {{ name }}_real dividend = given[9 + k];
    found[2 + (2 * k)] = dividend / {{ arithmetic.divisor }};
    found[3 + (2 * k)] = dividend / divisor;
  }
  found[{{ arithmetic.rest }}] = unit + quarter; /* a quarter of the last digit, and three: to the nearest */
  found[{{ arithmetic.rest + 1 }}] = unit + thrice;
  found[{{ arithmetic.rest + 2 }}] = smaller * {{ arithmetic.two }};
  found[{{ arithmetic.rest + 3 }}] = (inverse > {{ arithmetic.zero }}) ? unit : zero;
  found[{{ arithmetic.rest + 4 }}] = (none <= greatest) ? unit : zero;
  for (k = 0; k < {{ arithmetic.expected | length }}; k++) {
    const {{ name }}_real now = found[k];
    if (!(now == expected[k])) {
      exact = 0;
    }
  }
  return exact;
}
#endif

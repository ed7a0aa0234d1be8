{% import "helpers.c" as c %}
enum {
  EXPONENT_SHIFT = 23,
  EXPONENT_BIAS = 127,
  /* significand * 2^(field - 127 - 23) * 2^30 / 2^e is a shift by field - 120 - e */
  SHIFT_BIAS = 120
};
#define MAGNITUDE_MASK UINT32_C(0x7FFFFFFF)
#define FRACTION_MASK UINT32_C(0x007FFFFF)
#define HIDDEN_ONE UINT32_C(0x00800000)
#define INFINITY_BITS UINT32_C(0x7F800000)

${c.bits_of("float_bits")}
/* By the bits of the float, so that no compiler flag, rounding mode or missing FPU matters. */
int32_t ${name}_quantize_one(uint32_t bits, int32_t exponent, uint32_t *clipped, uint32_t *nan) {
  const uint32_t limit = (uint32_t)(EXPONENT_BIAS + exponent) << EXPONENT_SHIFT;
  uint32_t magnitude = bits & MAGNITUDE_MASK;
  *nan = (magnitude > INFINITY_BITS) ? 1U : 0U;
  *clipped = ((magnitude > limit) ? 1U : 0U) & ~*nan;
  magnitude = (magnitude > limit) ? limit : magnitude;
  const uint32_t field = magnitude >> EXPONENT_SHIFT;
  const uint32_t significand = (magnitude & FRACTION_MASK) | HIDDEN_ONE;
  /* field is at most 127 + exponent, so the shift to the left is at most 7. One to the right by
   * more than 24 gives zero, subnormal numbers included: 31 stands for all of those. */
  const int32_t shift = (int32_t)field - SHIFT_BIAS - exponent;
  const uint32_t negative = 0U - ((uint32_t)shift >> 31);
  const uint32_t left = (uint32_t)shift & ~negative & 7U;
  uint32_t right = (0U - (uint32_t)shift) & negative;
  right = (right > 31U) ? 31U : right;
  uint32_t value = (significand << left) >> right;
  value = (value > (UINT32_C(1) << 30)) ? (UINT32_C(1) << 30) : value; /* it is not: a guard */
  /* Factors of 1, -1 and 0 rather than branches: the time is the same for all data. */
  const int32_t sign = 1 - (int32_t)((bits >> 31) << 1);
  return (int32_t)value * sign * (int32_t)(1U - *nan);
}

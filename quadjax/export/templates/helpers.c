{# C functions that several files have. #}
{% macro bits_of(name) %}
static uint32_t ${name}(float value) {
  union {
    float value;
    uint32_t bits;
  } pun;
  pun.value = value;
  return pun.bits;
}
{% endmacro %}
{% macro float_of(name) %}
static float ${name}(uint32_t bits) {
  union {
    float value;
    uint32_t bits;
  } pun;
  pun.bits = bits;
  return pun.value;
}
{% endmacro %}
{% macro any_float() %}
/* Any bits: NaN, infinities and all numbers. */
static float any_float(void) {
  union {
    float value;
    unsigned bits;
  } pun;
  pun.bits = Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU);
  return pun.value;
}
{% endmacro %}
{% macro round_shift() %}
static int64_t round_shift(int64_t value, int32_t shift) {
  if (shift <= 0) {
    return value * (INT64_C(1) << -shift);
  }
  return (value + (INT64_C(1) << (shift - 1))) >> shift;
}
{% endmacro %}
{% macro scaled() %}
/* value * factor / 2^bits of a product that needs more than 64 bits, in two parts. */
static int64_t scaled(int64_t value, int64_t factor, int32_t bits) {
  const int64_t upper = value >> SPLIT;
  const int64_t lower = value & ((INT64_C(1) << SPLIT) - 1);
  return round_shift(upper * factor + ((lower * factor) >> SPLIT), bits - SPLIT);
}
{% endmacro %}
{% macro relu_upper_word(shift) %}
static int32_t relu_upper_word(int64_t sum) {
  const int32_t upper = (int32_t)(sum >> ${shift});
  return (upper > 0) ? upper : 0;
}
{% endmacro %}
{% macro quantize_all(to, count, number, size) %}
  for (uint32_t i = 0U; i < ${count}; ++i) {
    uint32_t clipped;
    uint32_t nan;
    ${to}[i] = ${number}, &clipped, &nan);
    status.clipped |= clipped << ${'i' if size <= 32 else '((i < 31U) ? i : 31U)'};
    status.nan |= nan << ${'i' if size <= 32 else '((i < 31U) ? i : 31U)'};
  }
  return status;
}
{% endmacro %}

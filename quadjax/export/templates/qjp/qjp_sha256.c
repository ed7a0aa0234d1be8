/* SHA-256 (FIPS 180-4). */
#include "qjp.h"

static const uint32_t round_constant[64] = {
${sha256_rounds | each("hex") | wrapped}};

static uint32_t rotate(uint32_t x, uint32_t n) { return (x >> n) | (x << (32U - n)); }

static void extend(const uint8_t *block, uint32_t w[64]) {
  for (uint32_t i = 0U; i < 16U; ++i) {
    const uint8_t *const b = block + 4U * i;
    w[i] = ((uint32_t)b[0] << 24) | ((uint32_t)b[1] << 16) | ((uint32_t)b[2] << 8) | b[3];
  }
  for (uint32_t i = 16U; i < 64U; ++i) {
    const uint32_t a = rotate(w[i - 15U], 7U) ^ rotate(w[i - 15U], 18U) ^ (w[i - 15U] >> 3);
    const uint32_t b = rotate(w[i - 2U], 17U) ^ rotate(w[i - 2U], 19U) ^ (w[i - 2U] >> 10);
    w[i] = w[i - 16U] + a + w[i - 7U] + b;
  }
}

static void compress(uint32_t h[8], const uint8_t *block) {
  uint32_t w[64];
  uint32_t v[8];
  extend(block, w);
  for (uint32_t i = 0U; i < 8U; ++i) {
    v[i] = h[i];
  }
  for (uint32_t i = 0U; i < 64U; ++i) {
    const uint32_t s1 = rotate(v[4], 6U) ^ rotate(v[4], 11U) ^ rotate(v[4], 25U);
    const uint32_t choice = (v[4] & v[5]) ^ (~v[4] & v[6]);
    const uint32_t t1 = v[7] + s1 + choice + round_constant[i] + w[i];
    const uint32_t s0 = rotate(v[0], 2U) ^ rotate(v[0], 13U) ^ rotate(v[0], 22U);
    const uint32_t majority = (v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]);
    for (uint32_t j = 7U; j > 0U; --j) {
      v[j] = v[j - 1U];
    }
    v[4] += t1;
    v[0] = t1 + s0 + majority;
  }
  for (uint32_t i = 0U; i < 8U; ++i) {
    h[i] += v[i];
  }
}

void qjp_sha256(const uint8_t *data, uint32_t size, uint8_t digest[32]) {
  uint32_t h[8] = {
${sha256_start | each("hex") | wrapped}};
  uint8_t last[128];
  const uint32_t whole = size & ~63U;
  const uint32_t rest = size - whole;
  const uint32_t padded = (rest < 56U) ? 64U : 128U;
  for (uint32_t i = 0U; i < whole; i += 64U) {
    compress(h, data + i);
  }
  for (uint32_t i = 0U; i < padded; ++i) {
    last[i] = (i < rest) ? data[whole + i] : ((i == rest) ? 0x80U : 0U);
  }
  for (uint32_t i = 0U; i < 8U; ++i) {
    last[padded - 1U - i] = (uint8_t)(((uint64_t)size * 8U) >> (8U * i));
  }
  for (uint32_t i = 0U; i < padded; i += 64U) {
    compress(h, last + i);
  }
  for (uint32_t i = 0U; i < 32U; ++i) {
    digest[i] = (uint8_t)(h[i >> 2] >> (24U - 8U * (i & 3U)));
  }
}

#define DIGEST_START UINT32_C(2166136261) /* FNV-1a over 32-bit words */
#define DIGEST_FACTOR UINT32_C(16777619)

static uint32_t digest_word(uint32_t digest, uint32_t word) {
  return (digest ^ word) * DIGEST_FACTOR;
}

static uint32_t digest_long(uint32_t digest, int64_t value) {
  const uint64_t bits = (uint64_t)value;
  return digest_word(digest_word(digest, (uint32_t)bits), (uint32_t)(bits >> 32));
}

static void digest_sums(uint32_t *trace, const int64_t *sums, uint32_t rows) {
  for (uint32_t row = 0U; row < rows; ++row) {
    *trace = digest_long(*trace, sums[row]);
  }
}

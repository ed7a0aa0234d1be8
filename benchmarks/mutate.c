/* A fuzzer of the loader and the pilot, in one process: see mutate.py.
 * mutate COUNT SEED SAMPLE FILE ..: every SAMPLEth mutated file goes to standard output, after its
 * length in bytes, the loader's error and the number of the file. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "qj.h"
#include "qj_words.h"

enum { LARGEST = 65536, STEPS = 20 };

/* A file may contain the right self-tests for whatever else it says: the pilot flies what only they
 * refuse. */
static qj_error error_of_load;
static qj_error load(qj_policy *policy, const int32_t *words, uint32_t bytes) {
  error_of_load = qj_load(policy, words, bytes);
  return (error_of_load == QJ_BAD_SELF_TEST) ? QJ_OK : error_of_load;
}
#define qj_load load
#include "qj_pilot.c"
#undef qj_load

static uint64_t state;
static uint32_t random_word(void) {
  state ^= state << 13;
  state ^= state >> 7;
  state ^= state << 17;
  return (uint32_t)(state >> 32);
}
static uint32_t below(uint32_t limit) { return random_word() % limit; }

static uint32_t crc32_of_bytes(const void *data, uint32_t count) {
  static uint32_t table[256];
  uint32_t crc = 0xFFFFFFFFU;
  for (uint32_t i = 0U; table[255] == 0U && i < 256U; ++i) {
    table[i] = i;
    for (int bit = 0; bit < 8; ++bit) { table[i] = (table[i] >> 1) ^ (0xEDB88320U & (0U - (table[i] & 1U))); }
  }
  for (uint32_t i = 0U; i < count; ++i) { crc = (crc >> 8) ^ table[(crc ^ ((const uint8_t *)data)[i]) & 255U]; }
  return ~crc;
}

static uint32_t edge(uint32_t old) {
  static const uint32_t edges[] = {0U, 1U, 2U, 3U, 4U, 7U, 8U, 31U, 32U, 33U, 62U, 63U, 64U, 127U, 128U,
      129U, 4095U, 4096U, 4097U, 65536U, 0x3FFFFFFFU, 0x40000000U, 0x40000001U, 0x7FFFFFFFU, 0x80000000U,
      0x80000001U, 0xC0000000U, 0xFFFFFFFEU, 0xFFFFFFFFU};
  switch (below(5U)) {
    case 0U: return old + 1U;
    case 1U: return old - 1U;
    case 2U: return old ^ (1U << below(32U));
    case 3U: return random_word() >> below(32U);
    default: return edges[below(sizeof(edges) / sizeof(edges[0]))];
  }
}

/* The number of words of a mutated file. */
static uint32_t mutate(uint32_t *words, uint32_t count, uint32_t tables) {
  for (uint32_t changes = 1U + below(3U); changes != 0U; --changes) {
    const uint32_t kind = below(10U);
    if (kind == 0U) { /* another length, which the header states or not */
      count = (below(2U) != 0U) ? 1U + below(count) : count + 1U + below(64U);
      if (below(4U) != 0U && count > QJ_HEADER_BYTES) { words[QJ_HEADER_BYTES] = 4U * count; }
    } else if (kind == 1U) { /* words elsewhere */
      memmove(words + below(count), words + below(count), 4U * below(16U));
    } else {
      const uint32_t limit = (kind < 5U) ? QJ_HEADER_WORDS : (kind < 9U) ? tables : count;
      const uint32_t place = below((limit < count) ? limit : count);
      words[place] = edge(words[place]);
    }
  }
  if (below(10U) != 0U) { words[count - 1U] = crc32_of_bytes(words, 4U * (count - 1U)); }
  return count;
}

/* Steps with any numbers: 1 if a command is not within the limits. */
static int fly(qj_pilot *pilot) {
  qj_vehicle vehicle;
  uint32_t *const numbers = (uint32_t *)&vehicle;
  uint32_t now = random_word();
  for (int step = 0; step < STEPS; ++step) {
    float command[QJ_COMMANDS];
    for (uint32_t i = 0U; i < sizeof(vehicle) / 4U; ++i) {
      numbers[i] = (below(4U) != 0U) ? qj_bits((float)(int32_t)random_word() / 1e8F) : random_word();
    }
    now += below(20000U);
    vehicle.time_us = now - ((below(8U) != 0U) ? below(1000U) : random_word());
    if (below(8U) == 0U) {
      qj_pilot_wait(pilot, &vehicle);
      continue;
    }
    const qj_pilot_status status = qj_pilot_step(pilot, now, (below(8U) != 0U) ? &vehicle : 0, command);
    for (int i = 0; i < QJ_COMMANDS && status == QJ_FLYING; ++i) {
      const float unit = 1.0F / (float)(UINT32_C(1) << pilot->policy.fraction_bits);
      const float slack = (pilot->policy.kind == QJ_RPM) ? 1.0F : 0.0F;
      if (!(command[i] >= (float)pilot->policy.low[i] * unit - slack &&
            command[i] <= (float)pilot->policy.high[i] * unit + slack)) { return 1; }
    }
  }
  return 0;
}

int main(int argc, char **argv) {
  static uint32_t original[16][LARGEST];
  static uint32_t sizes[16], tables[16];
  static uint32_t answers[16];
  const uint32_t count = (uint32_t)atol(argv[1]), sample = (uint32_t)atol(argv[3]), files = (uint32_t)argc - 4U;
  state = 88172645463325252ULL + (uint64_t)atol(argv[2]) * 7919U;
  for (uint32_t i = 0U; i < files && i < 16U; ++i) {
    FILE *const file = fopen(argv[4U + i], "rb");
    if (file == 0) { return 2; }
    sizes[i] = (uint32_t)fread(original[i], 4U, LARGEST - 128U, file);
    const uint32_t *const w = original[i];
    tables[i] = QJ_HEADER_WORDS + QJ_LAYER_WORDS * w[QJ_HEADER_LAYERS] + QJ_FIELD_WORDS * w[QJ_HEADER_FIELDS] +
                w[QJ_HEADER_STATE_SIZE] + QJ_PART_WORDS * w[QJ_HEADER_PARTS] + QJ_INPUT_WORDS * w[QJ_HEADER_INPUTS] +
                (QJ_GATE_WORDS + w[QJ_HEADER_CONSTANTS]) * w[QJ_HEADER_GATES];
    (void)fclose(file);
  }
  for (uint32_t number = 0U; number < count; ++number) {
    static uint32_t words[LARGEST];
    static qj_pilot pilot;
    const uint32_t which = below(files);
    memcpy(words, original[which], sizeof(words));
    const uint32_t length = mutate(words, sizes[which], tables[which]);
    const uint32_t bytes = 4U * length - ((below(50U) == 0U) ? below(4U) : 0U);
    int32_t *const exact = malloc(bytes + (bytes == 0U)); /* a read beyond is seen */
    memcpy(exact, words, bytes);
    const qj_interface interface = {(below(2U) != 0U) ? 0x1FFFFU : random_word(), 14U,
        (below(2U) != 0U) ? words[QJ_HEADER_PERIOD_NS] : 1U + below(20000000U)};
    const char *const wrong = qj_pilot_load(&pilot, exact, bytes, &interface);
    ++answers[error_of_load];
    if (wrong == 0 && fly(&pilot) != 0) { return 3; }
    if (sample != 0U && number % sample == 0U) {
      const uint32_t head[3] = {bytes, (uint32_t)error_of_load, which};
      (void)fwrite(head, sizeof(head), 1U, stdout);
      (void)fwrite(exact, 1U, bytes, stdout);
    }
    free(exact);
  }
  (void)fprintf(stderr, "answers of the loader, from ok on:");
  for (int i = 0; i < 14; ++i) { (void)fprintf(stderr, " %u", answers[i]); }
  (void)fprintf(stderr, "\n");
  return 0;
}

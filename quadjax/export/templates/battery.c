{% import "helpers.c" as c %}
/*
 * ${name}_battery: see ${name}_battery.h.
 *
${origin.lines | comment}
 *
 * Speeds and commands are integers of 2^-30 of their range; the memory is kept in fine units of 2^-40
 * of it. With w a measured speed, u its command and h the estimate, for each motor:
 *
 *   expected' = expected + k (min(u, h) - expected)
 *   limited'  = limited + k ([u >= h] - limited)
 *   error     = speed + lead (w - speed) - expected'
 *   speed'    = speed + k (w - speed)
 *
 * and h' = h + gain sum(error limited'), held to its limits.
 */
#include "${name}_battery.h"

enum {
  MOTORS = 4,
  NUMBERS = 8, /* speeds and commands */
  EXPONENT = ${battery.exponent},
  Q30 = 30,
  FINE_BITS = ${fine_bits},
  SPLIT = 16,
  LOW_PASS_BITS = ${battery.low_pass.shift},
  LEAD_BITS = ${battery.lead.shift},
  GAIN_BITS = ${battery.gain.shift},
  SELF_TESTS = ${battery_test.digests | length},
  TEST_ROWS = ${battery_test.samples | length},
  TEST_TURN = TEST_ROWS / 2 /* samples from one limit of the estimate to the other */
};

#define LOW_PASS INT64_C(${battery.low_pass.value}) /* k */
#define LEAD INT64_C(${battery.lead.value})
#define GAIN INT64_C(${battery.gain.value})
#define FINE (INT64_C(1) << (FINE_BITS - Q30)) /* fine units of 2^-30 of the range */
#define ONE (INT64_C(1) << FINE_BITS)          /* of limited */
#define LOWEST INT64_C(${battery.lowest})
#define HIGHEST INT64_C(${battery.highest})
#define FIRST INT64_C(${battery.first})

/* ---- integers ----------------------------------------------------------------------------------- */

${c.round_shift()}
${c.scaled()}
${c.float_of("from_bits")}
${c.bits_of("to_bits")}
static ${name}_status quantize(const ${name}_battery_sample *sample, int32_t q[NUMBERS]) {
  ${name}_status status = {0U, 0U};
  const float x[NUMBERS] = {sample->rpm[0],     sample->rpm[1],     sample->rpm[2],
                            sample->rpm[3],     sample->command[0], sample->command[1],
                            sample->command[2], sample->command[3]};
${c.quantize_all("q", "NUMBERS", name ~ "_quantize_one(to_bits(x[i]), EXPONENT", 8)}
/* ---- the estimate ------------------------------------------------------------------------------- */

static int64_t towards(int64_t past, int64_t now) {
  return past + scaled(now - past, LOW_PASS, LOW_PASS_BITS);
}

static int64_t held(int64_t highest) {
  highest = (highest > HIGHEST) ? HIGHEST : highest;
  return (highest < LOWEST) ? LOWEST : highest;
}

static void start(${name}_battery *battery, const int32_t s[NUMBERS]) {
  for (uint32_t i = 0U; i < MOTORS; ++i) {
    battery->speed[i] = s[i] * FINE;
    battery->expected[i] = s[i] * FINE;
    battery->limited[i] = 0;
  }
  battery->highest = FIRST;
  battery->started = 1U;
}

static void advance(${name}_battery *battery, const int32_t s[NUMBERS]) {
  const int64_t limit = battery->highest;
  int64_t sum = 0;
  for (uint32_t i = 0U; i < MOTORS; ++i) {
    const int64_t rpm = s[i] * FINE;
    const int64_t command = s[MOTORS + i] * FINE;
    battery->expected[i] = towards(battery->expected[i], (command >= limit) ? limit : command);
    battery->limited[i] = towards(battery->limited[i], (command >= limit) ? ONE : 0);
    const int64_t error = battery->speed[i] + scaled(rpm - battery->speed[i], LEAD, LEAD_BITS) -
                          battery->expected[i];
    battery->speed[i] = towards(battery->speed[i], rpm);
    sum += scaled(error, battery->limited[i] >> (FINE_BITS - Q30), Q30);
  }
  battery->highest = held(limit + scaled(sum, GAIN, GAIN_BITS));
}

static ${name}_status update(${name}_battery *battery, const ${name}_battery_sample *sample) {
  int32_t s[NUMBERS];
  const ${name}_status status = quantize(sample, s);
  if (battery->started == 0U) {
    start(battery, s);
  } else {
    advance(battery, s);
  }
  return status;
}

void ${name}_battery_reset(${name}_battery *battery) { battery->started = 0U; }

${name}_battery_status ${name}_battery_update(${name}_battery *battery,
                                            const ${name}_battery_sample *sample,
                                            float *highest_rpm) {
  const ${name}_status status = update(battery, sample);
  /* The unit is a power of two, so that this is one rounding. */
  *highest_rpm = (float)(int32_t)(battery->highest >> (FINE_BITS - Q30)) * ${unit}F;
  return status;
}

/* ---- self-test ---------------------------------------------------------------------------------- */

/* The bits of samples, used again and again. */
static const uint32_t test_sample[TEST_ROWS][NUMBERS] = {
${rows(battery_test.samples, "hex")}
};
/* A digest of the memory after each sample. */
static const uint32_t test_digest[SELF_TESTS] = {
${battery_test.digests | each("hex") | wrapped}
};

static uint32_t digest_of(uint32_t digest, int64_t value) {
  const uint64_t bits = (uint64_t)value;
  digest = (digest ^ (uint32_t)(bits & 0xFFFFFFFFU)) * UINT32_C(16777619);
  return (digest ^ (uint32_t)(bits >> 32)) * UINT32_C(16777619);
}

static uint32_t digest_all(uint32_t digest, const int64_t values[MOTORS]) {
  for (uint32_t i = 0U; i < MOTORS; ++i) {
    digest = digest_of(digest, values[i]);
  }
  return digest;
}

uint32_t ${name}_battery_self_test(void) {
  uint32_t mismatches = 0U;
  ${name}_battery battery = {{0}, {0}, {0}, 0, 0U};
  for (uint32_t number = 0U; number < SELF_TESTS; ++number) {
    const uint32_t *const bits = test_sample[number % TEST_ROWS];
    ${name}_battery_sample sample;
    for (uint32_t i = 0U; i < MOTORS; ++i) {
      sample.rpm[i] = from_bits(bits[i]);
      sample.command[i] = from_bits(bits[MOTORS + i]);
    }
    if ((number != 0U) && ((number % TEST_TURN) == 0U)) {
      battery.highest = ((number % TEST_ROWS) == 0U) ? LOWEST : HIGHEST;
    }
    (void)update(&battery, &sample);
    uint32_t digest = digest_all(UINT32_C(2166136261), battery.speed);
    digest = digest_all(digest, battery.expected);
    digest = digest_of(digest_all(digest, battery.limited), battery.highest);
    mismatches += (digest != test_digest[number]) ? 1U : 0U;
  }
  return mismatches;
}

#ifndef PREFLIGHT_CHECKS_H
#define PREFLIGHT_CHECKS_H
struct preflight_result_t { int fails; };
typedef void (*preflight_check_f)(struct preflight_result_t *result);
struct preflight_check_t { preflight_check_f func; struct preflight_check_t *next; };
void preflight_check_register(struct preflight_check_t *check, preflight_check_f func);
void preflight_error(struct preflight_result_t *result, const char *format, ...);
void preflight_success(struct preflight_result_t *result, const char *format, ...);
#endif

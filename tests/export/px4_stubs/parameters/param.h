#pragma once
#include <stdint.h>
typedef uintptr_t param_t;
param_t param_find(const char *name);
int param_get(param_t param, void *value);

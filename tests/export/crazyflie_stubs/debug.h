#pragma once
#define DEBUG_PRINT(...) stub_print(__VA_ARGS__)
void stub_print(const char *format, ...);

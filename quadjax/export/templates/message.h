/* Messages of format quadjax-sil/${version}: see the reference, Software-in-the-loop messages. */
#ifndef SIL_MESSAGE_H
#define SIL_MESSAGE_H

#include <stdint.h>

enum { SIL_VERSION = ${version} };
enum { SIL_HELLO = 1, SIL_STATE = 2, SIL_COMMAND = 3, SIL_END = 4 };
{% set types = {"S1": "char", "<u2": "uint16_t", "<u4": "uint32_t", "<f4": "float", "<f8": "double"} %}
{% for struct, fields in structs %}

/* ${sizes[struct]} bytes, little-endian, without padding. */
typedef struct {
{% if struct != "sil_header" %}
  sil_header header;
{% endif %}
{% for field, type, count, note in fields %}
  ${types[type]} ${field}${"[%d]" % count if count > 1 else ""}; /* ${note} */
{% endfor %}
} ${struct};
typedef char ${struct}_has_its_size[sizeof(${struct}) == ${sizes[struct]} ? 1 : -1];
{% endfor %}

{% if functions %}
/* What flies: in sil.c. */
const char *sil_load(void);       /* 0, or why the policy cannot fly */
uint32_t sil_own_estimator(void); /* whether the policy's estimator of disturbances runs */
void sil_begin(void);             /* a race begins with the next state */
void sil_step(const sil_state *from, sil_command *to);
{% endif %}

#endif

/* Sizes of the largest policy that is accepted; an export for one policy has its own. */
#ifndef QJ_SIZES_H
#define QJ_SIZES_H

#ifndef QJ_MAX_WIDTH
#define QJ_MAX_WIDTH 128 /* neurons or inputs of a layer, padded to a multiple of 8 */
#endif
#ifndef QJ_MAX_STATE
#define QJ_MAX_STATE 32 /* numbers of the state */
#endif

#endif /* QJ_SIZES_H */

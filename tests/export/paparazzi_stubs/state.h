/* Stand-ins for the few Paparazzi declarations that the module uses. */
#ifndef STATE_H
#define STATE_H
#include <stdint.h>
struct NedCoor_f { float x, y, z; };
struct FloatEulers { float phi, theta, psi; };
struct FloatQuat { float qi, qx, qy, qz; };
struct FloatRates { float p, q, r; };
struct FloatVect3 { float x, y, z; };
struct Int32Vect3 { int32_t x, y, z; };
struct FloatRMat { float m[9]; };
#define ACCEL_FLOAT_OF_BFP(a) ((float)(a) * 0.0009765625f)
struct NedCoor_f *stateGetPositionNed_f(void);
struct NedCoor_f *stateGetSpeedNed_f(void);
struct FloatEulers *stateGetNedToBodyEulers_f(void);
struct FloatQuat *stateGetNedToBodyQuat_f(void);
struct FloatRates *stateGetBodyRates_f(void);
struct Int32Vect3 *stateGetAccelBody_i(void);
struct FloatRMat *stateGetNedToBodyRMat_f(void);
void float_rmat_vmult(struct FloatVect3 *out, struct FloatRMat *m, const struct FloatVect3 *in);
#endif

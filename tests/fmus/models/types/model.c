#include <stdio.h>
#include <string.h>

#include "model.h"

#if FMI == 3
/* What the types that FMI 2 does not have count. */
static double more(Model *m)
{
    double sum = M(float32) + M(int8) + M(int16) + (double)M(int64) + M(uint8) + M(uint16);
    sum += M(uint32) + (double)M(uint64) + M(u_float32) + (double)M(u_int64) + M(u_uint8);
    for (size_t i = 0; i < M(blob).size; i++)
        sum += M(blob).bytes[i];
    for (int i = 0; i < 3; i++) {
        M(y_vector)[i] = M(weights)[i] + M(u_vector)[i];
        sum += M(y_vector)[i];
    }
    for (size_t i = 0; i < M(n); i++) {
        M(der_z)[i] = -M(rates)[i] * M(z)[i];
        M(y_z)[i] = M(z)[i];
    }
    M(y_float32) = M(float32) + M(u_float32);
    M(y_int8) = M(int8);
    M(y_int16) = M(int16);
    M(y_int64) = M(int64) + M(u_int64);
    M(y_uint8) = (UInt8)(M(uint8) + M(u_uint8));
    M(y_uint16) = M(uint16);
    M(y_uint32) = M(uint32);
    M(y_uint64) = M(uint64);
    M(y_blob) = M(blob);
    return sum;
}
#else
static double more(Model *m)
{
    (void)m;
    return 0.0;
}
#endif

int model_equations(Model *m)
{
    if (M(mode) < 1 || M(mode) > 3 || M(u_mode) < 1 || M(u_mode) > 3)
        return error(m, "mode and u_mode must be 1, 2 or 3");
    M(y_integer) = M(integer) + M(u_integer);
    M(y_boolean) = M(boolean) && !M(u_boolean);
    M(y_mode) = M(mode) > M(u_mode) ? M(mode) : M(u_mode);
    snprintf(M(y_text), TEXT_SIZE, "%.31s%.31s", M(text), M(u_text));
    M(der_x) = M(real) + M(u) + M(y_integer) + M(y_boolean) + (double)M(y_mode);
    M(der_x) += (double)strlen(M(y_text)) + more(m);
    M(y) = M(x);
    return OK;
}

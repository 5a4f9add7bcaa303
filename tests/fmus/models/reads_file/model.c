#include <stdio.h>

#include "model.h"

int model_equations(Model *m)
{
    if (M(gain) == 0.0)
        return error(m, "the file gain.txt cannot be read");
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(gain) * M(x);
    return OK;
}

void model_start(Model *m)
{
    FILE *file = fopen("gain.txt", "r");
    if (file == NULL)
        return;
    if (fscanf(file, "%lf", &M(gain)) != 1)
        M(gain) = 0.0;
    fclose(file);
}

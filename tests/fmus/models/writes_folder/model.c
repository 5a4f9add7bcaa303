#include <stdio.h>
#include <string.h>

#include "model.h"

static char counter[4096];

int model_resources(Model *m, const char *location)
{
    const char *path = location == NULL ? "" : location;
    if (strncmp(path, "file://", 7) == 0)
        path += 7;
    snprintf(counter, sizeof counter, "%s/runs.txt", path);
    return m != NULL ? OK : ERROR;
}

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = (1.0 + 0.01 * M(runs)) * M(x);
    return OK;
}

void model_start(Model *m)
{
    FILE *file = fopen(counter, "a");
    if (file == NULL)
        return;
    fputc('x', file);
    fseek(file, 0, SEEK_END);
    M(runs) = (double)ftell(file);
    fclose(file);
}

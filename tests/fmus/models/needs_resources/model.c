#include <dirent.h>
#include <string.h>

#include "decay.h"

int model_resources(Model *m, const char *location)
{
    const char *path = location == NULL ? "" : location;
    DIR *folder = opendir(strncmp(path, "file://", 7) == 0 ? path + 7 : path);
    if (folder == NULL)
        return error(m, "this model needs its folder of resources, even if nothing is in it");
    closedir(folder);
    return OK;
}

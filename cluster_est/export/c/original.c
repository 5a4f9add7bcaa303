#include "original.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#ifdef _WIN32
#include <windows.h>
static void *open_library(const char *path) {
    return (void *)LoadLibraryExA(path, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
}
static void close_library(void *library) { FreeLibrary((HMODULE)library); }
static void *look_up(void *library, const char *name) {
    FARPROC found = GetProcAddress((HMODULE)library, name);
    void *address;
    memcpy(&address, &found, sizeof address);
    return address;
}
static const char *why_not(void) { return "the system cannot load it"; }
#else
#include <dlfcn.h>
static void *open_library(const char *path) { return dlopen(path, RTLD_NOW | RTLD_LOCAL); }
static void close_library(void *library) { dlclose(library); }
static void *look_up(void *library, const char *name) { return dlsym(library, name); }
static const char *why_not(void) { return dlerror(); }
#endif

#if defined(_WIN32)
#define PLATFORM "win"
#define SUFFIX ".dll"
#elif defined(__APPLE__)
#define PLATFORM "darwin"
#define SUFFIX ".dylib"
#else
#define PLATFORM "linux"
#define SUFFIX ".so"
#endif

static int hexadecimal(char digit) {
    if (digit >= '0' && digit <= '9') return digit - '0';
    if (digit >= 'a' && digit <= 'f') return digit - 'a' + 10;
    if (digit >= 'A' && digit <= 'F') return digit - 'A' + 10;
    return -1;
}

/* The path of a file URI: "file:///a%20b" and "file:/a%20b" are "/a b". */
static char *path_of(const char *uri) {
    char *path = malloc(strlen(uri) + 1), *end = path;
    if (path == NULL) return NULL;
    if (strncmp(uri, "file://", 7) == 0)
        uri += strncmp(uri + 7, "localhost/", 10) == 0 ? 16 : 7;
    else if (strncmp(uri, "file:", 5) == 0)
        uri += 5;
#ifdef _WIN32
    if (uri[0] == '/' && uri[1] != '\0' && uri[2] == ':') uri++;
#endif
    while (*uri != '\0') {
        if (uri[0] == '%' && hexadecimal(uri[1]) >= 0 && hexadecimal(uri[2]) >= 0) {
            *end++ = (char)(16 * hexadecimal(uri[1]) + hexadecimal(uri[2]));
            uri += 3;
        } else {
            *end++ = *uri++;
        }
    }
    while (end > path && (end[-1] == '/' || end[-1] == '\\')) end--;
    *end = '\0';
    return path;
}

/* Fill in the functions. A function that the original lacks stays NULL. */
static void find_functions(Original *original) {
    void *found;
#define FIND(name, arguments)                           \
    found = look_up(original->library, "fmi2" #name);   \
    memcpy(&original->name, &found, sizeof found);
    FIND(Instantiate, )
    FIND(FreeInstance, )
    FMI2_FUNCTIONS(FIND)
#undef FIND
}

/* The first function that every wrapper calls and the original lacks, or NULL. */
static const char *missing(const Original *original) {
    if (original->Instantiate == NULL || original->FreeInstance == NULL) return "fmi2Instantiate";
    if (original->GetReal == NULL || original->SetReal == NULL) return "fmi2SetReal";
    if (original->Reset == NULL) return "fmi2Reset";
#if ORIGINAL_EXCHANGE
    if (original->GetDerivatives == NULL && N_STATES > 0) return "fmi2GetDerivatives";
    if (original->NewDiscreteStates == NULL) return "fmi2NewDiscreteStates";
#else
    if (original->DoStep == NULL) return "fmi2DoStep";
#endif
    return NULL;
}

int original_load(Original *original, const char *resources, const char *name,
                  const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length) {
    const char *inside = "/original/binaries/" PLATFORM, *absent;
    char *folder = path_of(resources == NULL ? "" : resources), *path;
    size_t size = strlen(resources == NULL ? "" : resources) + 512;
    memset(original, 0, sizeof *original);
    path = malloc(size);
    if (folder == NULL || path == NULL) {
        snprintf(why, length, "there is no memory left");
        free(folder);
        free(path);
        return -1;
    }
    snprintf(path, size, "%s%s%d/%s%s", folder, inside, (int)(8 * sizeof(void *)),
             ORIGINAL_IDENTIFIER, SUFFIX);
    original->library = open_library(path);
    if (original->library == NULL) {
        snprintf(why, length, "the original FMU's library %s cannot be loaded: %s", path,
                 why_not());
        free(folder);
        free(path);
        return -1;
    }
    free(folder);
    find_functions(original);
    absent = missing(original);
    if (absent == NULL) {
        snprintf(path, size, "%s/original/resources", resources);
        original->handle = original->Instantiate(
            name, ORIGINAL_EXCHANGE ? fmi2ModelExchange : fmi2CoSimulation, ORIGINAL_GUID, path,
            callbacks, visible, logging);
    }
    free(path);
    if (original->handle != NULL) return 0;
    if (absent != NULL)
        snprintf(why, length, "the original FMU must have the function %s but has not", absent);
    else
        snprintf(why, length, "the original FMU could not be instantiated");
    original_free(original);
    return -1;
}

void original_free(Original *original) {
    if (original->handle != NULL) original->FreeInstance(original->handle);
    if (original->library != NULL) close_library(original->library);
    original->handle = original->library = NULL;
}

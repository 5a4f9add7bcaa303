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
#define SYSTEM (ORIGINAL_FMI == 2 ? "win" : "windows")
#define SUFFIX ".dll"
#elif defined(__APPLE__)
#define SYSTEM "darwin"
#define SUFFIX ".dylib"
#else
#define SYSTEM "linux"
#define SUFFIX ".so"
#endif
#if defined(__aarch64__) || defined(_M_ARM64)
#define MACHINE "aarch64"
#elif defined(__x86_64__) || defined(_M_X64)
#define MACHINE "x86_64"
#else
#define MACHINE "x86"
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

int original_load(Original *original, Kept *kept, const char *resources, const char *name,
                  const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging,
                  char *why, size_t length) {
    const char *inside = "/original/binaries/", *absent;
    char *folder = path_of(resources == NULL ? "" : resources), *path;
    size_t size = strlen(resources == NULL ? "" : resources) + 512;
    memset(original, 0, sizeof *original);
    original->kept = kept;
    path = malloc(size);
    if (folder == NULL || path == NULL) {
        snprintf(why, length, "there is no memory left");
        free(folder);
        free(path);
        return -1;
    }
    if (ORIGINAL_FMI == 2)
        snprintf(path, size, "%s%s%s%d/%s%s", folder, inside, SYSTEM, (int)(8 * sizeof(void *)),
                 ORIGINAL_IDENTIFIER, SUFFIX);
    else
        snprintf(path, size, "%s%s" MACHINE "-%s/%s%s", folder, inside, SYSTEM,
                 ORIGINAL_IDENTIFIER, SUFFIX);
    original->library = open_library(path);
    if (original->library == NULL) {
        snprintf(why, length, "the original FMU's library %s cannot be loaded: %s", path,
                 why_not());
        free(folder);
        free(path);
        return -1;
    }
    absent = original_bind(original, look_up);
    if (absent == NULL) { /* FMI 2.0 wants a URI, and 3.0 a path */
        if (ORIGINAL_FMI == 2)
            snprintf(path, size, "%s/original/resources", resources);
        else
            snprintf(path, size, "%s/original/resources/", folder);
        original_instantiate(original, name, path, callbacks, visible, logging);
    }
    free(folder);
    free(path);
    if (absent == NULL && original->handle != NULL) return 0;
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

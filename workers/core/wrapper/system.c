#include "system.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <windows.h>
void *open_library(const char *path) {
    return (void *)LoadLibraryExA(path, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
}
void close_library(void *library) { FreeLibrary((HMODULE)library); }
void *look_up(void *library, const char *name) {
    FARPROC found = GetProcAddress((HMODULE)library, name);
    void *address;
    memcpy(&address, &found, sizeof address);
    return address;
}
const char *why_not_loaded(void) { return "the system cannot load it"; }
#else
#include <dlfcn.h>
void *open_library(const char *path) { return dlopen(path, RTLD_NOW | RTLD_LOCAL); }
void close_library(void *library) { dlclose(library); }
void *look_up(void *library, const char *name) { return dlsym(library, name); }
const char *why_not_loaded(void) { return dlerror(); }
#endif

static int hexadecimal(char digit) {
    if (digit >= '0' && digit <= '9') return digit - '0';
    if (digit >= 'a' && digit <= 'f') return digit - 'a' + 10;
    return digit >= 'A' && digit <= 'F' ? digit - 'A' + 10 : -1;
}

/* "file:///a%20b" and "file:/a%20b" are "/a b". */
char *path_of(const char *uri) {
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

void *read_file(const char *path, size_t *n_bytes) {
    FILE *file = fopen(path, "rb");
    char *content = NULL;
    if (file == NULL) return NULL;
    long size = fseek(file, 0, SEEK_END) == 0 ? ftell(file) : -1;
    if (size >= 0 && fseek(file, 0, SEEK_SET) == 0) content = malloc((size_t)size + 1);
    *n_bytes = content == NULL ? 0 : fread(content, 1, (size_t)size, file);
    fclose(file);
    return content;
}

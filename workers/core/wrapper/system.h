/* Files and libraries, as each system has them. */
#ifndef SYSTEM_H
#define SYSTEM_H
#include <stddef.h>

void *open_library(const char *path); /* NULL if it cannot be loaded */
void close_library(void *library);
void *look_up(void *library, const char *name);
const char *why_not_loaded(void);
/* The folder that a URI or a path names, without a slash at its end; to be freed. */
char *path_of(const char *uri);
/* The content of a file, to be freed; NULL if it cannot be read. */
void *read_file(const char *path, size_t *n_bytes);

#if defined(_WIN32)
#define SYSTEM_2 "win"
#define SYSTEM_3 "windows"
#define SUFFIX ".dll"
#elif defined(__APPLE__)
#define SYSTEM_2 "darwin"
#define SYSTEM_3 SYSTEM_2
#define SUFFIX ".dylib"
#else
#define SYSTEM_2 "linux"
#define SYSTEM_3 SYSTEM_2
#define SUFFIX ".so"
#endif
#if defined(__aarch64__) || defined(_M_ARM64)
#define MACHINE "aarch64"
#elif defined(__x86_64__) || defined(_M_X64)
#define MACHINE "x86_64"
#else
#define MACHINE "x86"
#endif

#endif

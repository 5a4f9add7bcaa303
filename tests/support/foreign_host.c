/* Does what it is told from standard input, so that a library for another processor or system can be
 * used from Python: it loads libraries, holds memory and calls functions by address.
 *
 * A request is ten numbers of 64 bits, little-endian: an operation, the size of what follows them,
 * and eight arguments. An answer is a number, the size of what follows it, and that.
 */
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#include <windows.h>
static void *loaded(const char *path) { return (void *)LoadLibraryA(path); }
static void *symbol(void *library, const char *name) {
    return (void *)GetProcAddress((HMODULE)library, name);
}
static void use_bytes(void) {
    _setmode(_fileno(stdin), _O_BINARY);
    _setmode(_fileno(stdout), _O_BINARY);
}
#else
#include <dlfcn.h>
static void *loaded(const char *path) { return dlopen(path, RTLD_NOW); }
static void *symbol(void *library, const char *name) { return dlsym(library, name); }
static void use_bytes(void) {}
#endif

/* fmi2CallbackFunctions */
typedef struct {
    void (*logger)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, int);
    void *environment;
} Callbacks;

static void log_to_stderr(void *environment, const char *instance, int status, const char *category,
                          const char *message, ...) {
    va_list arguments;
    (void)environment, (void)category;
    fprintf(stderr, "%s: status %d: ", instance, status);
    va_start(arguments, message);
    vfprintf(stderr, message, arguments);
    va_end(arguments);
}

typedef struct {
    uint64_t operation, size, a[8];
} Request;

typedef void *Instantiate(const char *, int, const char *, const char *, const Callbacks *, int, int);
typedef uint64_t Call(uint64_t, uint64_t, uint64_t);
typedef int64_t OfSignal(const double *, const double *, size_t, double, double *, double *);
typedef int64_t RateLimit(const double *, const double *, size_t, int, double, double, double *,
                          double *);

static double number(uint64_t bits) {
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

#define AT(type, address) ((type *)(uintptr_t)(address))

/* Returns the number to answer with; what follows it is `*size` bytes from that address on. */
static uint64_t done(const Request *q, const char *bytes, uint64_t *size) {
    static const Callbacks callbacks = {log_to_stderr, calloc, free, NULL, NULL};
    const uint64_t *a = q->a;
    switch (q->operation) {
    case 'L': return (uint64_t)(uintptr_t)loaded(bytes);
    case 'F': return (uint64_t)(uintptr_t)symbol(AT(void, a[0]), bytes);
    case 'I': /* a name and a GUID */
        return (uint64_t)(uintptr_t)AT(Instantiate, a[0])(
            bytes, (int)a[1], bytes + strlen(bytes) + 1, "", &callbacks, 0, 0);
    case 'P': {
        void *const memory = malloc(q->size + 1);
        if (memory != NULL) memcpy(memory, bytes, q->size);
        return (uint64_t)(uintptr_t)memory;
    }
    case 'G': *size = a[1]; return a[0];
    case 'D': free(AT(void, a[0])); return 0;
    case 'C': return AT(Call, a[0])(a[1], a[2], a[3]);
    case 'S':
        return (uint64_t)AT(OfSignal, a[0])(AT(double, a[1]), AT(double, a[2]), a[3], number(a[4]),
                                            AT(double, a[5]), AT(double, a[6]));
    case 'R': { /* its eight arguments follow */
        uint64_t b[8];
        memcpy(b, bytes, sizeof b);
        return (uint64_t)AT(RateLimit, a[0])(AT(double, b[0]), AT(double, b[1]), b[2], (int)b[3],
                                             number(b[4]), number(b[5]), AT(double, b[6]),
                                             AT(double, b[7]));
    }
    default: exit(2);
    }
}

int main(void) {
    Request q;
    use_bytes();
    while (fread(&q, sizeof q, 1, stdin) == 1) {
        char *const bytes = calloc(q.size + 1, 1);
        if (bytes == NULL || fread(bytes, 1, q.size, stdin) != q.size) return 1;
        uint64_t answer[2] = {0, 0};
        answer[0] = done(&q, bytes, &answer[1]);
        fwrite(answer, sizeof answer, 1, stdout);
        if (answer[1] > 0) fwrite(AT(void, answer[0]), 1, answer[1], stdout);
        fflush(stdout);
        free(bytes);
    }
    return 0;
}

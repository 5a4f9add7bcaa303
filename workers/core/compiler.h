/* What compilers are told of functions and branches. */
#ifndef COMPILER_H
#define COMPILER_H

#define ALWAYS static inline __attribute__((always_inline))
#define RARELY __attribute__((noinline, cold))
#define LIKELY(x) __builtin_expect(!!(x), 1)
#define UNLIKELY(x) __builtin_expect(!!(x), 0)

#endif

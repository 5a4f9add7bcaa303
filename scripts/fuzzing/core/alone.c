/* Hands files to a fuzzer's function, where there is no libFuzzer: to see again what was found. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n);

int main(int n_arguments, char **arguments) {
    enum { MOST = 1 << 20 };
    for (int j = 1; j < n_arguments; j++) {
        FILE *const file = fopen(arguments[j], "rb");
        if (file == NULL) return perror(arguments[j]), 2;
        uint8_t *const room = malloc(MOST), *bytes = NULL;
        const size_t n = room ? fread(room, 1, MOST, file) : 0;
        fclose(file);
        bytes = malloc(n + 1);
        for (size_t k = 0; bytes && k < n; k++) bytes[k] = room[k];
        free(room);
        LLVMFuzzerTestOneInput(bytes, n);
        free(bytes);
    }
    return 0;
}

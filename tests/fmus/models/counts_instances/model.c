/* For each instance that is made, a line "MADE PROCESS ALIVE" in the file `log`: how many there are
   with it, over all processes. For each that is freed, a line "FREED PROCESS". An instance ends when
   it is freed, or when its process begins to end. One at a time enters, by a lock on `door`. */
#include <dirent.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <unistd.h>

#include "model.h"

enum { PF_EXITING = 4 }; /* of the kernel's flags of a process: its memory is given back next */

static int inside(const char *folder, const char *name, int how)
{
    char path[4200];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return open(path, how | O_CREAT, 0600);
}

static int enter(const char *folder)
{
    int door = inside(folder, "door", O_RDWR);
    if (door < 0 || flock(door, LOCK_EX) != 0)
        abort();
    return door;
}

static bool lives(int process)
{
    char path[64], state = 'X';
    unsigned flags = PF_EXITING;
    snprintf(path, sizeof path, "/proc/%d/stat", process);
    FILE *file = fopen(path, "r");
    if (file == NULL)
        return false;
    if (fscanf(file, "%*d (%*[^)]) %c %*d %*d %*d %*d %*d %u", &state, &flags) != 2)
        flags = PF_EXITING;
    fclose(file);
    return state != 'Z' && state != 'X' && !(flags & PF_EXITING);
}

static int count(const char *folder)
{
    int alive = 0, process;
    DIR *files = opendir(folder);
    if (files == NULL)
        abort();
    for (struct dirent *file; (file = readdir(files)) != NULL;)
        if (sscanf(file->d_name, "instance-%d-", &process) == 1)
            alive += lives(process);
    closedir(files);
    return alive;
}

static void note(const char *folder, const char *line)
{
    int log = inside(folder, "log", O_WRONLY | O_APPEND);
    if (log < 0 || write(log, line, strlen(line)) != (ssize_t)strlen(line))
        abort();
    close(log);
}

static const char *mark(const Model *m)
{
    static char name[64];
    snprintf(name, sizeof name, "instance-%d-%p", (int)getpid(), (const void *)m);
    return name;
}

int model_accept(Model *m)
{
    const char *folder = getenv("INSTANCES_COUNTED_IN");
    if (folder == NULL)
        return OK;
    char line[64];
    int door = enter(folder);
    close(inside(folder, mark(m), O_WRONLY));
    snprintf(line, sizeof line, "MADE %d %d\n", (int)getpid(), count(folder));
    note(folder, line);
    close(door);
    return OK;
}

void model_free(Model *m)
{
    const char *folder = getenv("INSTANCES_COUNTED_IN");
    if (folder == NULL)
        return;
    char line[64], path[4200];
    int door = enter(folder);
    snprintf(path, sizeof path, "%s/%s", folder, mark(m));
    unlink(path);
    snprintf(line, sizeof line, "FREED %d\n", (int)getpid());
    note(folder, line);
    close(door);
}

void model_start(Model *m)
{
    if (M(k) > 2.5)
        raise(SIGSEGV);
}

int model_equations(Model *m)
{
    if (M(k) > 2.0)
        return FATAL;
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(x);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    if (known == V_k)
        return NAN;
    if (unknown == V_y)
        return known == V_x;
    if (unknown != V_der_x)
        return 0.0;
    return known == V_x ? -M(k) : known == V_u;
}

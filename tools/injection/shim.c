/* Loaded before the C library into a process whose files are to fail: counts the calls that change
   files below one folder, makes one of them fail or kills the process in front of it, and can let
   the clock run backwards.

   Not covered: stdio (fopen, fwrite), C++ streams, mmap, io_uring; Python's own files use none. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static char folder[PATH_MAX];
static long count, failing;
static int error_number, trace = -1;
static int is_backwards;
static struct timespec turned;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* path: absolute. call: the one that fails, from 1 on; 0: none. error: errno; 0: SIGKILL instead.
   trace_path: file that gets a line for each call. */
void faults_arm(const char *path, long call, int error, const char *trace_path) {
    snprintf(folder, sizeof folder, "%s", path);
    count = 0;
    failing = call;
    error_number = error;
    if (trace >= 0) syscall(SYS_close, trace);
    trace =
        syscall(SYS_openat, AT_FDCWD, trace_path, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
}

void faults_disarm(void) {
    *folder = 0;
}

/* The time of day counts down from now on. */
void faults_turn_clock(void) {
    REAL(clock_gettime)(CLOCK_REALTIME, &turned);
    is_backwards = 1;
}

/* Whether this call fails. path: absolute, or relative to the folder open as `at`. */
static int fails(const char *kind, int at, const char *path) {
    char whole[2 * PATH_MAX] = "", link[64];
    if (!*folder) return 0;
    if (path && path[0] == '/') {
        snprintf(whole, sizeof whole, "%s", path);
    } else {
        snprintf(link, sizeof link, at == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", at);
        ssize_t length = readlink(link, whole, PATH_MAX - 1);
        if (length < 0) return 0;
        snprintf(whole + length, sizeof whole - length, path ? "/%s" : "%s", path ? path : "");
    }
    size_t length = strlen(folder);
    if (strncmp(whole, folder, length) || (whole[length] && whole[length] != '/')) return 0;
    count++;
    int saved = errno, chosen = count == failing;
    if (trace >= 0) {
        char line[2 * PATH_MAX + 64];
        const char *rest = whole[length] ? whole + length + 1 : ".";
        int size = snprintf(line, sizeof line, "%s%s %s\n", chosen ? "! " : "", kind, rest);
        syscall(SYS_write, trace, line, (size_t)size);
    }
    if (chosen && !error_number) kill(getpid(), SIGKILL);
    errno = chosen ? error_number : saved;
    return chosen;
}

#define WRITING (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)
#define OPEN(name)                                                                                 \
    int name(const char *path, int flags, ...) {                                                   \
        va_list list;                                                                              \
        va_start(list, flags);                                                                     \
        mode_t mode = flags & O_CREAT ? va_arg(list, mode_t) : 0;                                  \
        va_end(list);                                                                              \
        return flags & WRITING && fails("open", AT_FDCWD, path) ? -1                               \
                                                                : REAL(name)(path, flags, mode);   \
    }
#define OPENAT(name)                                                                               \
    int name(int at, const char *path, int flags, ...) {                                           \
        va_list list;                                                                              \
        va_start(list, flags);                                                                     \
        mode_t mode = flags & O_CREAT ? va_arg(list, mode_t) : 0;                                  \
        va_end(list);                                                                              \
        return flags & WRITING && fails("open", at, path) ? -1                                     \
                                                          : REAL(name)(at, path, flags, mode);     \
    }
OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)

/* A disk that becomes full takes the first part. */
ssize_t write(int file, const void *data, size_t size) {
    if (fails("write", file, NULL)) {
        int error = errno;
        REAL(write)(file, data, size / 2);
        errno = error;
        return -1;
    }
    return REAL(write)(file, data, size);
}

#define ON_FILE(name, kind)                                                                        \
    int name(int file) {                                                                           \
        return fails(kind, file, NULL) ? -1 : REAL(name)(file);                                    \
    }
ON_FILE(fsync, "fsync")
ON_FILE(fdatasync, "fsync")

/* Closed all the same, as the kernel does. */
int close(int file) {
    int flags = *folder ? fcntl(file, F_GETFL) : -1;
    int chosen = flags >= 0 && flags & (O_WRONLY | O_RDWR) && fails("close", file, NULL);
    int status = REAL(close)(file);
    if (chosen) errno = error_number;
    return chosen ? -1 : status;
}

int flock(int file, int operation) {
    return fails("flock", file, NULL) ? -1 : REAL(flock)(file, operation);
}

int ftruncate(int file, off_t size) {
    return fails("truncate", file, NULL) ? -1 : REAL(ftruncate)(file, size);
}

int ftruncate64(int file, off64_t size) {
    return fails("truncate", file, NULL) ? -1 : REAL(ftruncate64)(file, size);
}

int rename(const char *from, const char *to) {
    return fails("rename", AT_FDCWD, to) ? -1 : REAL(rename)(from, to);
}

int renameat(int at_from, const char *from, int at_to, const char *to) {
    return fails("rename", at_to, to) ? -1 : REAL(renameat)(at_from, from, at_to, to);
}

int mkdir(const char *path, mode_t mode) {
    return fails("mkdir", AT_FDCWD, path) ? -1 : REAL(mkdir)(path, mode);
}

int mkdirat(int at, const char *path, mode_t mode) {
    return fails("mkdir", at, path) ? -1 : REAL(mkdirat)(at, path, mode);
}

#define ON_PATH(name)                                                                              \
    int name(const char *path) {                                                                   \
        return fails("remove", AT_FDCWD, path) ? -1 : REAL(name)(path);                            \
    }
ON_PATH(unlink)
ON_PATH(rmdir)

int unlinkat(int at, const char *path, int flags) {
    return fails("remove", at, path) ? -1 : REAL(unlinkat)(at, path, flags);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    int status = REAL(clock_gettime)(clock, time);
    if (!status && is_backwards && clock == CLOCK_REALTIME) {
        long long nanoseconds = (time->tv_sec - turned.tv_sec) * 1000000000LL;
        nanoseconds += time->tv_nsec - turned.tv_nsec;
        nanoseconds = turned.tv_sec * 1000000000LL + turned.tv_nsec - nanoseconds;
        time->tv_sec = nanoseconds / 1000000000LL;
        time->tv_nsec = nanoseconds % 1000000000LL;
    }
    return status;
}

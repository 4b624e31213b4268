/* Notes in the file WATCH_LOG, one line each and in their order, what a program does to files, folders and its clients:
 *   W path       bytes are about to be written     S path   all of it is on the disk
 *   C path       it was made                       R a b    a has the name b now
 *   U path       it is removed                     A        an answer is about to be sent that says that something is safe
 * While the file FAIL_WHILE is there, syncing a file whose path ends in what that file holds is an I/O error.
 * To be preloaded: LD_PRELOAD. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

static int note_to = -1;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("WATCH_LOG");
    if (path) note_to = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0666);
}

static void note(const char *what, const char *one, const char *other) {
    char line[9000];
    int length = snprintf(line, sizeof line, "%s %s%s%s\n", what, one, *other ? " " : "", other);
    if (note_to >= 0 && length < (int)sizeof line) syscall(SYS_write, note_to, line, length);
}

/* Where an open file is. Not all are files. */
static const char *path_of(int fd, char path[4096]) {
    char link[40];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, 4095);
    path[length < 0 ? 0 : length] = 0;
    return path;
}

static void wrote(int fd) {
    char path[4096];
    if (*path_of(fd, path) == '/') note("W", path, "");
}

static int fails(const char *path) {
    const char *trigger = getenv("FAIL_WHILE");
    int fd = trigger ? syscall(SYS_openat, AT_FDCWD, trigger, O_RDONLY | O_CLOEXEC) : -1;
    if (fd < 0) return 0;
    char end[4096];
    ssize_t length = syscall(SYS_read, fd, end, sizeof end), all = strlen(path);
    syscall(SYS_close, fd);
    return length > 0 && length <= all && !memcmp(path + all - length, end, length);
}

static int synced(int fd, int (*real)(int)) {
    char path[4096];
    path_of(fd, path);
    if (fails(path)) {
        errno = EIO;
        return -1;
    }
    int done = real(fd);
    if (!done) note("S", path, "");
    return done;
}

int fsync(int fd) { return synced(fd, REAL(fsync)); }
int fdatasync(int fd) { return synced(fd, REAL(fdatasync)); }

static void answered(const void *bytes, size_t length) {
    /* Of a tile, and the end of a stream; what an image's status says of a region is no promise. */
    static const char *safe[] = {"{\"state\":\"", "\"state\":\"end\"", "HTTP/1.1 201", "HTTP/1.1 204"};
    for (size_t i = 0; i < sizeof safe / sizeof *safe; i++)
        if (memmem(bytes, length, safe[i], strlen(safe[i]))) {
            note("A", safe[i], "");
            return;
        }
}

ssize_t send(int fd, const void *bytes, size_t length, int flags) {
    answered(bytes, length);
    return REAL(send)(fd, bytes, length, flags);
}

static int is_socket(int fd) {
    struct stat found;
    return !fstat(fd, &found) && S_ISSOCK(found.st_mode);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    if (!is_socket(fd))
        wrote(fd);
    else
        for (int i = 0; i < count; i++) answered(parts[i].iov_base, parts[i].iov_len);
    return REAL(writev)(fd, parts, count);
}

ssize_t write(int fd, const void *bytes, size_t length) {
    if (!is_socket(fd))
        wrote(fd);
    else
        answered(bytes, length);
    return REAL(write)(fd, bytes, length);
}

ssize_t pwrite64(int fd, const void *bytes, size_t length, off64_t at) {
    wrote(fd);
    return REAL(pwrite64)(fd, bytes, length, at);
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    int fd = REAL(open64)(path, flags, va_arg(rest, int));
    va_end(rest);
    if (fd >= 0 && (flags & O_CREAT) && (flags & O_EXCL)) note("C", path, "");
    return fd;
}

int mkdir(const char *path, mode_t mode) {
    int done = REAL(mkdir)(path, mode);
    if (!done) note("C", path, "");
    return done;
}

int rename(const char *from, const char *to) {
    int done = REAL(rename)(from, to);
    if (!done) note("R", from, to);
    return done;
}

int unlink(const char *path) {
    note("U", path, "");
    return REAL(unlink)(path);
}

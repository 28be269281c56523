/* Log of what a program changes on a disk, for benchmarks/power_failure.py; loaded with LD_PRELOAD.
 *
 * DISK_TRACE_ROOT names the directory whose files are logged, DISK_TRACE the log. Each entry is a line "KIND INODE
 * NUMBER SIZE NANOSECONDS" and SIZE bytes: of "write" the data, of the others paths. NUMBER is the offset of a write,
 * the new size of a "truncate", and joins "begin" and "end" of an fsync. Changes are logged in their order, under a
 * lock; an fsync is logged before and after, without one.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static atomic_ullong syncs;
static const char *root;
static int trace_fd = -1;

__attribute__((constructor)) static void start(void)
{
    const char *path = getenv("DISK_TRACE");
    root = getenv("DISK_TRACE_ROOT");
    if (path && root)
        trace_fd = (int)syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
}

static int inside(const char *path)
{
    size_t length = root ? strlen(root) : 0;
    return trace_fd >= 0 && strncmp(path, root, length) == 0 && (path[length] == '/' || path[length] == 0);
}

static int path_of(int fd, char *path)
{
    char link[32];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, 4095);
    path[length > 0 ? length : 0] = 0;
    return length > 0 && inside(path);
}

static void enter(const char *kind, unsigned long long inode, long long number, const void *data, size_t size)
{
    char head[128];
    struct timespec now;
    int error = errno;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int length = snprintf(head, sizeof head, "%s %llu %lld %zu %lld\n", kind, inode, number, size,
                          now.tv_sec * 1000000000LL + now.tv_nsec);
    struct iovec parts[] = {{head, (size_t)length}, {(void *)data, size}};
    if (syscall(SYS_writev, trace_fd, parts, 2) != (long)(length + (long)size))
        abort();
    errno = error;
}

static unsigned long long inode_of(int fd)
{
    struct stat status;
    return fstat(fd, &status) ? 0 : status.st_ino;
}

static int opened(int (*open_file)(int, const char *, int, ...), int directory, const char *name, int flags, int mode)
{
    char path[4096];
    pthread_mutex_lock(&lock);
    int is_new = (flags & O_CREAT) && faccessat(directory, name, F_OK, AT_SYMLINK_NOFOLLOW) != 0;
    int fd = open_file(directory, name, flags, mode);
    if (fd >= 0 && (is_new || (flags & O_TRUNC)) && path_of(fd, path))
        enter(is_new ? "make" : "truncate", inode_of(fd), 0, path, strlen(path));
    pthread_mutex_unlock(&lock);
    return fd;
}

#define MODE                                                 \
    int mode = 0;                                            \
    if (flags & (O_CREAT | O_TMPFILE)) {                     \
        va_list arguments;                                   \
        va_start(arguments, flags);                          \
        mode = va_arg(arguments, int);                       \
        va_end(arguments);                                   \
    }
int open(const char *name, int flags, ...) { MODE return opened(REAL(openat), AT_FDCWD, name, flags, mode); }
int open64(const char *name, int flags, ...) { MODE return opened(REAL(openat64), AT_FDCWD, name, flags, mode); }
int openat(int directory, const char *name, int flags, ...) { MODE return opened(REAL(openat), directory, name, flags, mode); }
int openat64(int directory, const char *name, int flags, ...) { MODE return opened(REAL(openat64), directory, name, flags, mode); }

static ssize_t wrote(int fd, const void *data, ssize_t written, long long offset)
{
    char path[4096];
    if (written > 0 && path_of(fd, path))
        enter("write", inode_of(fd), offset >= 0 ? offset : lseek(fd, 0, SEEK_CUR) - written, data, (size_t)written);
    return written;
}

#define LOCKED(type, call)            \
    pthread_mutex_lock(&lock);        \
    type result = call;               \
    pthread_mutex_unlock(&lock);      \
    return result;
ssize_t write(int fd, const void *data, size_t size)
{
    char path[4096];
    if (!path_of(fd, path)) /* a pipe may block */
        return REAL(write)(fd, data, size);
    LOCKED(ssize_t, wrote(fd, data, REAL(write)(fd, data, size), -1))
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { LOCKED(ssize_t, wrote(fd, data, REAL(pwrite)(fd, data, size, at), at)) }
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) { LOCKED(ssize_t, wrote(fd, data, REAL(pwrite64)(fd, data, size, at), at)) }

static int truncated(int fd, int result, long long size)
{
    char path[4096];
    if (result == 0 && path_of(fd, path))
        enter("truncate", inode_of(fd), size, path, strlen(path));
    return result;
}
int ftruncate(int fd, off_t size) { LOCKED(int, truncated(fd, REAL(ftruncate)(fd, size), size)) }
int ftruncate64(int fd, off64_t size) { LOCKED(int, truncated(fd, REAL(ftruncate64)(fd, size), size)) }

static int synced(int (*sync_file)(int), int fd)
{
    char path[4096];
    if (!path_of(fd, path))
        return sync_file(fd);
    unsigned long long number = ++syncs, inode = inode_of(fd);
    pthread_mutex_lock(&lock);
    enter("begin", inode, (long long)number, path, strlen(path));
    pthread_mutex_unlock(&lock);
    int result = sync_file(fd);
    pthread_mutex_lock(&lock);
    if (result == 0)
        enter("end", inode, (long long)number, path, strlen(path));
    pthread_mutex_unlock(&lock);
    return result;
}
int fsync(int fd) { return synced(REAL(fsync), fd); }
int fdatasync(int fd) { return synced(REAL(fdatasync), fd); }

static int named(const char *kind, int result, const char *path)
{
    struct stat status = {0};
    if (result == 0 && inside(path)) {
        stat(path, &status);
        enter(kind, status.st_ino, 0, path, strlen(path));
    }
    return result;
}
int mkdir(const char *path, mode_t mode) { LOCKED(int, named("mkdir", REAL(mkdir)(path, mode), path)) }
int unlink(const char *path) { LOCKED(int, named("remove", REAL(unlink)(path), path)) }
int rmdir(const char *path) { LOCKED(int, named("remove", REAL(rmdir)(path), path)) }

static int moved(int result, const char *old, const char *new)
{
    char both[8192];
    if (result == 0 && inside(old)) {
        int length = snprintf(both, sizeof both, "%s%c%s", old, 0, new);
        enter("rename", 0, 0, both, (size_t)length);
    }
    return result;
}
int rename(const char *old, const char *new) { LOCKED(int, moved(REAL(rename)(old, new), old, new)) }

/* LD_PRELOADed into linux.uml: pads its PTRACE_SETREGSET(NT_X86_XSTATE).
 *
 * Debian's User-Mode Linux (6.1, 6.12) writes back the 2696 bytes of FPU state it
 * knows. A CPU with AMX has more, the host then refuses the short write (EFAULT)
 * and the guest panics. The missing tail is AMX state, which the guest never
 * uses: send zeros for it and mark it unused.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { PEEKTEXT = 1, PEEKUSER = 3, GETREGSET = 0x4204, SETREGSET = 0x4205, XSTATE = 0x202 };
#define XSTATE_BV 512            /* offset of the bit map of used components */
#define AMX (1UL << 17 | 1UL << 18)

static unsigned char state[1 << 16] __attribute__((aligned(64)));

static long host(long request, long pid, void *addr, void *data)
{
    return syscall(SYS_ptrace, request, pid, addr, data);
}

static long set_xstate(long pid, const struct iovec *given)
{
    static size_t wanted;
    struct iovec all = {state, sizeof state};
    unsigned long used;

    if (!wanted) {
        if (host(GETREGSET, pid, (void *)XSTATE, &all) < 0)
            return -1;
        wanted = all.iov_len;
    }
    if (given->iov_len >= wanted)
        return host(SETREGSET, pid, (void *)XSTATE, (void *)given);
    memset(state, 0, wanted);
    memcpy(state, given->iov_base, given->iov_len);
    memcpy(&used, state + XSTATE_BV, sizeof used);
    used &= ~AMX;
    memcpy(state + XSTATE_BV, &used, sizeof used);
    all.iov_len = wanted;
    return host(SETREGSET, pid, (void *)XSTATE, &all);
}

long ptrace(int request, ...)
{
    va_list rest;
    long pid, word;
    void *addr, *data;

    va_start(rest, request);
    pid = va_arg(rest, int);
    addr = va_arg(rest, void *);
    data = va_arg(rest, void *);
    va_end(rest);

    if (request == SETREGSET && (long)addr == XSTATE)
        return set_xstate(pid, data);
    if (request < PEEKTEXT || request > PEEKUSER)
        return host(request, pid, addr, data);
    /* The system call stores the word, libc's function returns it. */
    if (host(request, pid, addr, &word) < 0)
        return -1;
    errno = 0;
    return word;
}

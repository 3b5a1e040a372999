/* A disk that is full after so many bytes of each file: every write beyond fails. POSIX. */
#ifndef BAKELITE_LIMIT_FILES_H
#define BAKELITE_LIMIT_FILES_H

#include "check.h"

#include <sys/resource.h>

static inline void limit_files(rlim_t bytes) {
    struct rlimit r;
    CHECK(getrlimit(RLIMIT_FSIZE, &r) == 0);
    r.rlim_cur = bytes;
    CHECK(setrlimit(RLIMIT_FSIZE, &r) == 0);
}

#endif

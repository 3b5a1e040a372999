/* What the test programs share: checks that print where they fail and count. C99 and C++17. */
#ifndef BAKELITE_CHECK_H
#define BAKELITE_CHECK_H

#include <bakelite.h>
#include <stdio.h>
#include <string.h>

static int checks_done = 0;
static int checks_failed = 0;

static inline void check_at(int ok, const char *what, const char *file, int line) {
    checks_done++;
    if (!ok) {
        checks_failed++;
        fprintf(stderr, "%s:%d: failed: %s (last error: %s)\n", file, line, what, bk_last_error());
    }
}

/* The result is BK_OK. */
static inline void check_ok_at(bk_result result, const char *what, const char *file, int line) {
    checks_done++;
    if (result != BK_OK) {
        checks_failed++;
        fprintf(stderr, "%s:%d: %s gives %s: %s\n", file, line, what, bk_result_string(result), bk_last_error());
    }
}

/* The result is an error, and its sentence contains `culprit`. */
static inline void check_error_at(bk_result result, bk_result expected, const char *culprit, const char *what,
                                  const char *file, int line) {
    checks_done++;
    if (result != expected) {
        checks_failed++;
        fprintf(stderr, "%s:%d: %s gives %s, not %s: %s\n", file, line, what, bk_result_string(result),
                bk_result_string(expected), bk_last_error());
    } else if (strstr(bk_last_error(), culprit) == NULL) {
        checks_failed++;
        fprintf(stderr, "%s:%d: %s does not name \"%s\": %s\n", file, line, what, culprit, bk_last_error());
    }
}

#define CHECK(condition) check_at((condition) ? 1 : 0, #condition, __FILE__, __LINE__)
#define CHECK_OK(call) check_ok_at((call), #call, __FILE__, __LINE__)
#define CHECK_ERROR(call, code, culprit) check_error_at((call), (code), (culprit), #call, __FILE__, __LINE__)

/* An empty light map of a scene of about one unit, small enough for a test. */
static inline bk_lightmap *small_lightmap(const bk_scene *scene, uint32_t page_size) {
    bk_lightmap *lightmap = NULL;
    bk_lightmap_desc desc;
    bk_lightmap_desc_init(&desc);
    desc.page_size = page_size;
    desc.texels_per_unit = 16.0f;
    desc.gather_divisor = desc.radiance_divisor = 2;
    CHECK_OK(bk_lightmap_create(scene, &desc, NULL, NULL, &lightmap));
    return lightmap;
}

static inline int check_report(const char *program) {
    printf("%s: %d checks, %d failed\n", program, checks_done, checks_failed);
    return checks_failed == 0 ? 0 : 1;
}

#endif

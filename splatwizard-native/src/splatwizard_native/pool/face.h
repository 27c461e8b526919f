// The threads on which all native modules run.
#pragma once
#include <splatwizard/c_face.h>

// Runs a loop, as `sw_run` says. Ranges are cut as torch cuts its own, by the number of threads alone.
SW_EXPORT void splatwizard_pool_run(int32_t threads, int64_t count, int64_t grain, sw_body body, void* state);

// Lets loops run on the threads of the OpenMP library that torch brings, given the address of its GOMP_parallel: a team
// of our own would fight for the cores with threads that spin at the end of torch's loops. Not in processes that are
// forked from this one later: there, as without such a library, threads of our own do the work.
SW_EXPORT void splatwizard_pool_borrow(void* gomp_parallel);

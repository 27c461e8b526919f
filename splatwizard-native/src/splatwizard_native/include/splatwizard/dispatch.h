// One kernel source, several instruction sets.
//
// The files that a NativeModule lists as `kernels` are compiled once per instruction set, each time with SW_ARCH
// defined as another namespace: arch_native for a build on the machine that runs it, arch_v2, arch_v3 and arch_v4
// (the x86-64 levels) for a binary that travels. A kernel file puts everything into `namespace SW_ARCH`.
// The header that the binding file reads declares it for all of them:
//
//   #define DECLARE(arch) namespace arch { void scale(float* x, int64_t n); }
//   SW_FOR_EACH_ARCH(DECLARE)
//
// and the binding calls SW_SELECT(scale)(x, n): the best one that this CPU can run.
#pragma once

#ifdef SW_PORTABLE_X86
#define SW_FOR_EACH_ARCH(X) X(arch_v2) X(arch_v3) X(arch_v4)
#define SW_SELECT(function)                       \
  (splatwizard::x86_level() >= 4   ? arch_v4::function \
   : splatwizard::x86_level() == 3 ? arch_v3::function \
                                   : arch_v2::function)

namespace splatwizard {

inline int x86_level() {
  // By feature, not by __builtin_cpu_supports("x86-64-v4"), which older compilers do not know.
  static const int level = [] {
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
    const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                    __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                    __builtin_cpu_supports("avx512vl");
    return v4 ? 4 : v3 ? 3 : 2;
  }();
  return level;
}

}  // namespace splatwizard

#else
#define SW_FOR_EACH_ARCH(X) X(arch_native)
#define SW_SELECT(function) arch_native::function
#endif

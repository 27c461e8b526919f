// The plain C face of a native module: what C, C++, ctypes, Rust and WebAssembly see of it. No torch, no Python.
//
// A module has one header of this form, which Python reads too (splatwizard_native/face.py), so its grammar is narrow:
// one field a line or several of one type, and the rule of each in the comment beside it.
//
//   typedef struct {
//     sw_head head;
//     const float* x;    // [rows, columns]        a tensor: dtype from the type, shape from the brackets
//     int64_t rows, columns;                    // filled from the shapes, where the caller leaves them out
//     float* slopes;     // [rows] or null         may be left out
//     const int64_t* table;  // [rows, 3] strided  need not be contiguous; the caller says how rows lie
//     int32_t found;     // out                    a result, read after the call
//   } find_call;
//   SW_OPERATION(my_module, find);                 // int32_t my_module_find(find_call*), 0 or my_module_last_error()
//
// Memory is always the caller's. Where a size depends on data there are two operations, one that counts and one that
// fills. `sw_real*` is float32 or float64, the same for all of a call, told by its `real_bytes`.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define SW_ABI 1

#if defined(_WIN32)
#define SW_VISIBLE __declspec(dllexport)
#else
#define SW_VISIBLE __attribute__((visibility("default")))
#endif
#ifdef __cplusplus
#define SW_EXPORT extern "C" SW_VISIBLE
#else
#define SW_EXPORT SW_VISIBLE
#endif

#define SW_OPERATION(module, operation) SW_EXPORT int32_t module##_##operation(operation##_call* call)

typedef void sw_real;

// How loops run on threads: body(state, begin, end) on disjoint ranges that cover [0, count), each at least `grain`
// long but the last, on at most `threads` threads.
typedef void (*sw_body)(void* state, int64_t begin, int64_t end);
typedef void (*sw_run)(int32_t threads, int64_t count, int64_t grain, sw_body body, void* state);

// How every call begins.
typedef struct {
  uint32_t size;    // bytes of the whole struct
  uint32_t abi;     // SW_ABI of the caller
  int32_t threads;  // at most
  int32_t device;   // number of the GPU; -1: the CPU
  void* stream;     // of the GPU
  sw_run run;       // null: loops run in the caller's thread
} sw_head;

#ifdef __cplusplus

#include <cstdio>
#include <exception>
#include <stdexcept>

#include <splatwizard/parallel.h>

namespace splatwizard {

inline thread_local char last_error[512] = "";

// Ends the call with this text, to be completed as by printf.
template <class... Values>
[[noreturn]] void refuse(const char* text, Values... values) {
  if constexpr (sizeof...(values) == 0)
    std::snprintf(last_error, sizeof(last_error), "%s", text);
  else
    std::snprintf(last_error, sizeof(last_error), text, values...);
  throw std::invalid_argument(last_error);
}

// The body of an operation: body(parallel). No exception leaves a library; each becomes a status and a text.
template <class Call, class Body>
int32_t guarded(const Call* call, const Body& body) noexcept {
  try {
    if (call->head.size != sizeof(Call) || call->head.abi != SW_ABI)
      refuse("the caller has ABI %u and %u bytes, the library ABI %u and %u", call->head.abi, call->head.size,
             unsigned(SW_ABI), unsigned(sizeof(Call)));
    const int threads = call->head.run == nullptr || call->head.threads < 1 ? 1 : call->head.threads;
    body(Parallel{call->head.run, threads});
    return 0;
  } catch (const std::exception& error) {
    if (error.what() != last_error) std::snprintf(last_error, sizeof(last_error), "%s", error.what());
  } catch (...) {
    std::snprintf(last_error, sizeof(last_error), "unknown error");
  }
  return 1;
}

}  // namespace splatwizard

// What a library says of itself. The build adds it to every module.
#define SW_FACE(module, hash)                                              \
  SW_EXPORT uint32_t module##_abi() { return SW_ABI; }                     \
  SW_EXPORT const char* module##_hash() { return hash; }                   \
  SW_EXPORT const char* module##_last_error() { return splatwizard::last_error; }

#endif  // __cplusplus

#include "networks.h"

#include "arrays.h"

namespace swz {

namespace {

constexpr splatwizard::Parallel ALONE;

}  // namespace

Weights::Weights(Container& file, int64_t count) {
  const Json* stated = file.value("weights");
  if (stated == nullptr || !(stated->is("float32") || stated->is("float16")))
    refuse("header value 'weights' must be one of float32, float16");
  const Bytes data = file.section("networks");
  const Blame blame("networks");
  const bool halves = stated->is("float16");
  const int64_t size = halves ? 2 : 4;
  if (data.left != count * size)
    refuse("is ", grouped(data.left), " bytes, the networks need ", grouped(count * size));
  numbers = Buffer<float>(count);
  bool finite = true;
  for (int64_t i = 0; i < count; ++i) {
    numbers[i] = halves ? half(data.data + 2 * i) : float_at(data.data + 4 * i);
    finite &= __builtin_isfinite(numbers[i]);
  }
  if (!finite) refuse("a weight is not finite");
}

IntegerNetwork::IntegerNetwork(const FileLayer* from, int64_t count, const double* scale, const char* prefix)
    : depth(count) {
  constexpr double ONE = 4096, LARGEST = 4096, INPUT = 1 << 20, EXACT = 9007199254740992.0;
  for (int64_t l = 0; l < count; ++l) {
    const FileLayer& file = from[l];
    Buffer<double> weights(file.inputs * file.outputs), bias(file.outputs);
    bool fits = true, exact = true;
    for (int64_t row = 0; row < file.outputs; ++row) {
      const double unit = l == count - 1 && scale != nullptr ? scale[row] : 1;
      double sum = 0;
      for (int64_t i = row * file.inputs; i < (row + 1) * file.inputs; ++i) {
        weights[i] = __builtin_rint(double{file.weights[i]} * unit * ONE);
        sum += __builtin_fabs(weights[i]);
        fits &= __builtin_fabsf(file.weights[i]) <= LARGEST;
      }
      bias[row] = __builtin_rint(double{file.bias[row]} * unit * (ONE * ONE));
      exact &= sum * INPUT + __builtin_fabs(bias[row]) < EXACT;
    }
    if (!fits) refuse(prefix, "layer ", l, ": a weight is not finite or exceeds 4096");
    if (!exact) refuse(prefix, "layer ", l, ": sums could reach 2^53 and would not be exact");
    layers[l] = {weights.data, bias.data, file.inputs, file.outputs};
    numbers[l][0] = static_cast<Buffer<double>&&>(weights);
    numbers[l][1] = static_cast<Buffer<double>&&>(bias);
  }
}

void IntegerNetwork::operator()(int64_t rows, const int64_t* first, int64_t width, int64_t stride,
                                const int64_t* second, int64_t second_width, int64_t second_stride, int64_t* out,
                                int64_t leak) const {
  arch_native::network({layers, depth, {first, second}, {width, second_width}, {stride, second_stride}, nullptr, rows, leak},
                       out, ALONE);
}

void IntegerNetwork::operator()(int64_t rows, const int16_t* inputs, int64_t* out) const {
  arch_native::network({layers, depth, {}, {}, {}, inputs, rows, 0}, out, ALONE);
}

}  // namespace swz

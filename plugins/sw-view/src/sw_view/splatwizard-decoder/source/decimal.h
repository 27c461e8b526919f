// The float64 nearest to a decimal number, a tie going to the even one.
#pragma once

namespace swz {

// Of -digits.digits e exponent, as JSON has it; at most 511 characters. Infinity beyond the range.
double nearest_float64(const char* text);

}  // namespace swz

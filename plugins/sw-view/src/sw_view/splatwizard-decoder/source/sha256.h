// SHA-256 (FIPS 180-4).
#pragma once
#include "base.h"

namespace swz {

struct Sha256 {
  void put(const void* data, int64_t bytes);
  void finish(char* hexadecimal);  // 64 digits and a 0

 private:
  uint32_t state[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  uint8_t block[64];
  uint64_t length = 0;

  void take_block();
};

}  // namespace swz

"""Operations that a training repeats at every step, fused: the photometric loss and Adam."""

"""Operations that a training repeats at every step, fused: activations, the photometric loss and Adam."""

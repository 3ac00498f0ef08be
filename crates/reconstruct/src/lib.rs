//! Stage 1: losses, schedules, density control, checkpoints

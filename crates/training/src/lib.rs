//! What both training loops share: observers, checkpoints, view order, the guard against non-finite numbers.

//! Stage 2: objective, loop, the enhanced scene

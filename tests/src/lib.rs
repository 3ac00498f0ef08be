//! Tests that need several crates at once; they are in `tests/tests/`. This library is empty.

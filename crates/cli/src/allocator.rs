//! The number of places from which the C library takes memory.
//!
//! glibc gives threads arenas of their own. Memory that is freed in one arena does not serve threads of
//! another, and most of it never goes back to the system. Several threads load and train the views, so a
//! training of 1280×720 held a third more memory than with one arena. Few arenas for all threads end this.

#![expect(unsafe_code, reason = "calling a function of the C library that takes two numbers")]

use std::env;

/// Threads that share one arena. Small pieces of memory rarely wait for an arena; large ones wait briefly.
const THREADS_PER_ARENA: usize = 4;

/// Lets `threads` threads share few arenas, unless the user has set their number. It must run before the
/// first thread starts, because an arena that exists stays.
pub(crate) fn share_arenas(threads: usize) {
    if ["MALLOC_ARENA_MAX", "GLIBC_TUNABLES"].iter().any(|name| env::var_os(name).is_some()) {
        return;
    }
    let arenas = i32::try_from(threads.div_ceil(THREADS_PER_ARENA)).unwrap_or(i32::MAX);
    // SAFETY: the function takes two numbers and checks both.
    let accepted = unsafe { libc::mallopt(libc::M_ARENA_MAX, arenas) };
    if accepted == 0 {
        tracing::debug!("the C library did not accept {arenas} arenas");
    }
}

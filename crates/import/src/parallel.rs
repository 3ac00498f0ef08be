//! Work on the items of a list by a few threads, each with one item at a time.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::ImportError;

/// Runs `work(0..n)` on a few threads, each thread one item at a time, and returns the results in order. The
/// first failure (by index, among the items that ran) stops the rest.
pub(crate) fn in_parallel<T: Send>(
    n: usize,
    workers: usize,
    work: impl Fn(usize) -> Result<T, ImportError> + Sync,
) -> Result<Vec<T>, ImportError> {
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
    let results: Vec<Mutex<Option<Result<T, ImportError>>>> = (0..n).map(|_| Mutex::new(None)).collect();
    std::thread::scope(|scope| {
        for _ in 0..workers.min(n) {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    let i = next.fetch_add(1, Ordering::Relaxed);
                    if i >= n {
                        break;
                    }
                    let result = work(i);
                    if result.is_err() {
                        stop.store(true, Ordering::Relaxed);
                    }
                    *results[i].lock().unwrap_or_else(PoisonError::into_inner) = Some(result);
                }
            });
        }
    });
    let mut out = Vec::with_capacity(n);
    for result in results {
        match result.into_inner().unwrap_or_else(PoisonError::into_inner) {
            Some(Ok(value)) => out.push(value),
            Some(Err(error)) => return Err(error),
            None => continue, // not started: a later index failed, and its error follows
        }
    }
    Ok(out)
}

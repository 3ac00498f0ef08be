//! Stages, keys, cache, plans, batches, report

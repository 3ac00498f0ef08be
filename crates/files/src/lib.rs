//! Files that are there whole or not at all, and the temporary names that this takes.
//!
//! Whatever is being made lies under a temporary name until it is finished, and is renamed then. Every such
//! name is made by [`unique`]: it says which process made it, so that what a killed process left can be
//! removed ([`sweep`]), and it has 64 bits of chance in it, since two containers may have one host name, one
//! process id and one start time. A temporary file is always *created*, never opened ([`create_beside`]): a
//! file or a link that somebody laid under that name beforehand is left alone, and another name is taken.

mod atomic;
mod making;
mod names;
mod owner;
mod sweep;

pub use atomic::write_atomically;
pub use making::{Making, abandon};
pub use names::{BEING_MADE, beside, create_beside, folder_of, unique};
pub use owner::{ProcessId, host, random};
pub use sweep::sweep;

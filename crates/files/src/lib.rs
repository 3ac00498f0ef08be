//! Files that are complete or absent, and the temporary names that this needs.
//!
//! An unfinished file has a temporary name and is renamed when it is complete. [`unique`] makes every such
//! name. The name contains the process that owns it, so [`sweep`] can remove the leftovers of killed
//! processes. It also contains 64 random bits, because two containers may have the same host name, process
//! id and start time. A temporary file is always *created*, never opened ([`create_beside`]). If a file or a
//! link already has the name, it stays as it is, and another name is used. A file of a fixed name is opened
//! by [`no_link`], which fails where a link has the name.

mod atomic;
mod making;
mod names;
mod owner;
mod sweep;

pub use atomic::write_atomically;
pub use making::{Making, abandon};
pub use names::{BEING_MADE, beside, create_beside, folder_of, no_link, unique};
pub use owner::{ProcessId, host, random};
pub use sweep::sweep;

//! Serves a scene to a browser: a finished scene, or one that is being trained. The page itself is made by
//! the crate `web`.
//!
//! ```text
//! training ──figures, copies of the scene──▶ Live ◀──state, commands── Site ◀── Server ◀── browser
//!    ▲                                         │                        │
//!    └──── pause, stop ────────────────────────┘        Drawing ◀───────┘ looks, pictures
//! ```
//!
//! A finished scene is sent to the browser, which draws it. A changing scene is drawn here, by the program's
//! own renderer, from a *copy*: no lock is held and nothing is shared while it is drawn. So the training
//! gives the same result with and without a viewer.
//!
//! **Cost.** During a training, pictures are drawn by one thread. After each picture it rests, so that
//! drawing takes no more than its [share](Live::set_share) of the machine's cores. Copies are taken only
//! while a page is open, at least two seconds apart.
//!
//! **Pacing.** A browser requests a picture after it has shown the one before. If one page has sent several
//! requests, only the newest counts. On a slow machine a moving picture is drawn smaller.
//!
//! **Safety.** The server answers only this machine. Requests must address it as loopback (no foreign `Host`)
//! and come from its own page (no foreign `Origin`). They must carry a token that only the printed address
//! contains, in the part that browsers never send. Heads, bodies, connections and waiting times are bounded.
//! No request names a file.

pub mod browser;
mod curve;
mod drawing;
mod guard;
mod http;
mod live;
mod server;
mod site;

pub use browser::Redirect;
pub use live::{Live, Shown};
pub use server::{Server, ServerError};

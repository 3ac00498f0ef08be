//! A scene in a browser, served by the program: a finished one, or one that is being trained.
//!
//! ```text
//! training ──figures, copies of the scene──▶ Live ◀──state, commands── Site ◀── Server ◀── browser
//!    ▲                                         │                        │
//!    └──── pause, stop ────────────────────────┘        Drawing ◀───────┘ looks, pictures
//! ```
//!
//! The page is `web`'s. A finished scene is handed over and drawn by the browser; one that changes is drawn
//! here, by the program's own renderer, from a *copy* of it: no lock is held and nothing is shared while it
//! is drawn, so what is trained comes out the same with and without somebody looking on.
//!
//! **Cost.** Beside a training, pictures are drawn by one thread, and after each it rests for so long that
//! drawing takes no more than its [share](Live::set_share) of the machine's cores. Copies are taken while
//! somebody looks, two seconds apart or more.
//!
//! **Pacing.** A browser asks for a picture when it has shown the one before. Of several requests of one page
//! the newest counts, and a machine that is slow draws a moving picture smaller.
//!
//! **Safety.** The server answers this machine alone. Requests must name it as loopback (no foreign
//! `Host`), come from its own page (no foreign `Origin`) and carry a token that only the printed address
//! holds, in the part that browsers never send. Heads, bodies, connections and waiting times are
//! bounded. No request names a file.

mod curve;
mod drawing;
mod guard;
mod http;
mod live;
mod server;
mod site;

pub use live::{Live, Shown};
pub use server::{Server, ServerError};

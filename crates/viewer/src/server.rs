//! Sockets and threads: one thread accepts connections, one per connection answers, one draws.

use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use crate::drawing::Drawing;
use crate::guard::{Token, refusal};
use crate::http::{self, NoRequest, Response};
use crate::live::Live;
use crate::site::Site;

/// Largest number of connections that are served at a time: a browser opens up to six per page. A further one
/// replaces the oldest that has not shown the token, so clients without the token cannot keep others out. If
/// all have shown it, the further one gets the answer that there are too many. Above twice this number,
/// connections are closed without an answer.
const CONNECTIONS: usize = 56;

/// A server that cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// Another program uses the port.
    #[error(
        "port {0} is taken on this machine; choose another with --port N, or leave --port out and a free one is taken"
    )]
    PortTaken(u16),
    /// The system refuses to listen.
    #[error("cannot listen on port {port} of this machine: {source}; choose another with --port N")]
    Listen {
        /// The port.
        port: u16,
        /// The system's error.
        source: std::io::Error,
    },
    /// No thread or no random numbers are available.
    #[error("the viewer cannot be started: {0}")]
    Start(String),
}

/// A server on this machine's loopback address; it ends when it is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    token: Token,
    closing: Arc<AtomicBool>,
    drawing: Arc<Drawing>,
}

/// Starts a thread with a name.
fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
    thread::Builder::new().name(name.into()).spawn(work).map(drop)
}

impl Server {
    /// Starts serving the scene of `live` on `port`, or on the first free port if none is given.
    ///
    /// # Errors
    /// Returns [`ServerError`] if the server cannot start.
    pub fn start(port: Option<u16>, live: &Arc<Live>) -> Result<Self, ServerError> {
        let asked = port.unwrap_or(0);
        let listener =
            TcpListener::bind((Ipv4Addr::LOCALHOST, asked)).map_err(|source| match source.kind() {
                std::io::ErrorKind::AddrInUse => ServerError::PortTaken(asked),
                _ => ServerError::Listen { port: asked, source },
            })?;
        let address = listener.local_addr().map_err(|source| ServerError::Listen { port: asked, source })?;
        let start = |error: &dyn std::fmt::Display| ServerError::Start(error.to_string());
        let token = Token::new().map_err(|e| start(&e))?;
        let drawing = Drawing::new(live.clone());
        let site = Arc::new(Site::new(live.clone(), drawing.clone()));
        let closing = Arc::new(AtomicBool::new(false));
        let drawer = drawing.clone();
        spawn("viewer drawing", move || drawer.work()).map_err(|e| start(&e))?;
        let accepting = Accepting {
            site,
            token: token.clone(),
            closing: closing.clone(),
            open: Arc::default(),
            guests: Arc::default(),
        };
        spawn("viewer", move || accepting.accept(&listener)).map_err(|e| start(&e))?;
        Ok(Self { address, token, closing, drawing })
    }

    /// The address to open in a browser, with the token.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/#{}", self.port(), self.token.0)
    }

    /// The port.
    pub fn port(&self) -> u16 {
        self.address.port()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.drawing.close();
        // Wakes the thread that accepts. If this fails, the thread ends with the next connection.
        let _ = TcpStream::connect(self.address);
    }
}

#[derive(Clone)]
struct Accepting {
    site: Arc<Site>,
    token: Token,
    closing: Arc<AtomicBool>,
    /// The number of connections, with those that are being closed.
    open: Arc<AtomicUsize>,
    guests: Arc<Mutex<Guests>>,
}

/// The connections that are served, oldest first.
#[derive(Default)]
struct Guests {
    next: u64,
    all: Vec<Guest>,
}

struct Guest {
    number: u64,
    /// A second handle of the socket, to close it.
    stream: TcpStream,
    /// True if it has shown the token.
    known: bool,
}

impl Guests {
    /// Admits a connection and returns its number. If there is no room, it replaces a connection that has not
    /// shown the token.
    fn admit(&mut self, stream: &TcpStream) -> Option<u64> {
        if self.all.len() >= CONNECTIONS {
            let unknown = self.all.iter().position(|guest| !guest.known)?;
            let _ = self.all.remove(unknown).stream.shutdown(Shutdown::Both);
        }
        let (number, stream) = (self.next, stream.try_clone().ok()?);
        self.next += 1;
        self.all.push(Guest { number, stream, known: false });
        Some(number)
    }

    fn has_shown_the_token(&mut self, number: u64) {
        self.all.iter_mut().filter(|guest| guest.number == number).for_each(|guest| guest.known = true);
    }

    fn leave(&mut self, number: u64) {
        self.all.retain(|guest| guest.number != number);
    }
}

impl Accepting {
    fn accept(&self, listener: &TcpListener) {
        for stream in listener.incoming() {
            if self.closing.load(Ordering::Relaxed) {
                return;
            }
            let Ok(mut stream) = stream else { continue };
            let before = self.open.fetch_add(1, Ordering::Relaxed);
            if before >= 2 * CONNECTIONS {
                self.open.fetch_sub(1, Ordering::Relaxed);
                continue;
            }
            let this = self.clone();
            let served = spawn("viewer page", move || {
                let admitted = this.guests().admit(&stream);
                if let Some(number) = admitted {
                    this.serve(&mut stream, number);
                    this.guests().leave(number);
                } else {
                    let why = "too many connections; close other pages of this viewer";
                    http::refuse(&mut stream, &Response::text(503, why));
                }
                this.open.fetch_sub(1, Ordering::Relaxed);
            });
            if served.is_err() {
                self.open.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }

    fn guests(&self) -> std::sync::MutexGuard<'_, Guests> {
        self.guests.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Answers a connection's requests, one after another.
    fn serve(&self, stream: &mut TcpStream, number: u64) {
        let _ = stream.set_nodelay(true);
        let mut pending = Vec::new();
        while !self.closing.load(Ordering::Relaxed) {
            let request = match http::read(stream, &mut pending) {
                Ok(request) => request,
                Err(NoRequest::Gone) => return,
                Err(NoRequest::Refused(status, why)) => {
                    http::refuse(stream, &Response::text(status, why));
                    return;
                }
            };
            let refused = refusal(&request, &self.token);
            if refused.is_none() && request.method == "POST" {
                self.guests().has_shown_the_token(number);
            }
            let response = refused.unwrap_or_else(|| self.site.answer(&request));
            if http::write(stream, &response, request.stays).is_err() || !request.stays {
                return;
            }
        }
    }
}

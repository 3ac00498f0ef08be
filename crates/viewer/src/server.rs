//! Sockets and threads: one that accepts, one per open connection, one that draws.

use std::net::Shutdown;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use crate::drawing::Drawing;
use crate::guard::{Token, refusal};
use crate::http::{self, NoRequest, Pending, Response};
use crate::live::Live;
use crate::site::Site;

/// Most connections at a time: a browser holds up to six per page. One more takes the place of the oldest that
/// has not shown the token, so that nobody who does not know it keeps others out; where all have, it is told
/// that they are too many. At twice the number, further ones are closed without a word.
const CONNECTIONS: usize = 56;

/// A server that cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The port is somebody else's.
    #[error(
        "port {0} is taken on this machine; choose another with --port N, or leave --port out and a free one is taken"
    )]
    PortTaken(u16),
    /// The system refuses to listen.
    #[error("cannot listen on port {port} of this machine: {source}; choose another with --port N")]
    Listen {
        /// Which port.
        port: u16,
        /// Why.
        source: std::io::Error,
    },
    /// No thread, or no random numbers.
    #[error("the viewer cannot be started: {0}")]
    Start(String),
}

/// A server on this machine's loopback address; it ends when it is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    token: Token,
    closing: Arc<AtomicBool>,
    drawing: Ender,
}

/// Ends the drawing thread.
struct Ender(Arc<Drawing>);

impl std::fmt::Debug for Ender {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Drawing")
    }
}

impl Server {
    /// Starts serving what `live` shows, on `port`; on the first free one without.
    ///
    /// # Errors
    /// [`ServerError`].
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
        thread::Builder::new()
            .name("viewer drawing".into())
            .spawn(move || drawer.work())
            .map_err(|e| start(&e))?;
        let accepting = Accepting {
            site,
            token: token.clone(),
            closing: closing.clone(),
            open: Arc::default(),
            guests: Arc::default(),
        };
        thread::Builder::new()
            .name("viewer".into())
            .spawn(move || accepting.accept(&listener))
            .map_err(|e| start(&e))?;
        Ok(Self { address, token, closing, drawing: Ender(drawing) })
    }

    /// What to open in a browser, token and all.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/#{}", self.port(), self.token.text())
    }

    /// The port.
    pub fn port(&self) -> u16 {
        self.address.port()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.drawing.0.close();
        // Wakes the thread that accepts; should it fail, the thread ends with the next visitor.
        let _ = TcpStream::connect(self.address);
    }
}

#[derive(Clone)]
struct Accepting {
    site: Arc<Site>,
    token: Token,
    closing: Arc<AtomicBool>,
    /// Connections, those that are being closed among them.
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
    /// The socket once more, to close it.
    stream: TcpStream,
    /// Whether it has shown the token.
    known: bool,
}

impl Guests {
    /// Takes a connection in, in the place of one that has not shown the token where there is no room; its
    /// number.
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
            let served = thread::Builder::new().name("viewer page".into()).spawn(move || {
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
        let mut pending = Pending::default();
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

//! Access control: only this machine's own page that knows the token gets an answer.
//!
//! A page of another site can send requests to any address, including this one. It cannot change the `Origin`
//! that its browser adds, and cannot read the token. If it uses a name of its own that resolves to this
//! machine (DNS rebinding), that name appears in `Host`.

use crate::http::{HttpRequest, Response};

/// The secret at the end of the printed address.
#[derive(Clone, Debug)]
pub(crate) struct Token(pub(crate) String);

impl Token {
    /// 128 random bits in hexadecimal.
    pub(crate) fn new() -> Result<Self, getrandom::Error> {
        let mut bits = [0u8; 16];
        getrandom::fill(&mut bits)?;
        Ok(Self(bits.iter().map(|b| format!("{b:02x}")).collect()))
    }

    /// Compares in a time that does not depend on the position of the first difference.
    fn is(&self, given: &str) -> bool {
        let (own, given) = (self.0.as_bytes(), given.as_bytes());
        own.len() == given.len() && own.iter().zip(given).fold(0, |apart, (a, b)| apart | (a ^ b)) == 0
    }
}

/// True if a `Host` names this machine's loopback. The port may differ, as behind a tunnel.
fn is_loopback(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    ["127.0.0.1", "localhost", "::1"].iter().any(|own| name.eq_ignore_ascii_case(own))
}

/// The refusal of a request; `None` if it is allowed. The page itself contains no secret and is open to
/// everyone on this machine; all other requests need `POST` with origin and token.
pub(crate) fn refusal(request: &HttpRequest, token: &Token) -> Option<Response> {
    let forbidden = |what: &str| Some(Response::text(403, what));
    let Some(host) = request.host.as_deref().filter(|host| is_loopback(host)) else {
        return forbidden("this server answers only requests to 127.0.0.1 and localhost");
    };
    let own = format!("http://{host}");
    if request.origin.as_deref().is_some_and(|origin| !origin.eq_ignore_ascii_case(&own)) {
        return forbidden("another site's page may not use this server");
    }
    match (request.method.as_str(), request.path.as_str()) {
        ("GET", "/") => None,
        ("GET", _) => {
            Some(Response::text(404, "there is nothing here; open the address that the program printed"))
        }
        ("POST", _) if request.origin.is_none() => {
            forbidden("the request does not say which page it comes from")
        }
        ("POST", _) => {
            let given = request.authorization.as_deref().and_then(|text| text.strip_prefix("Bearer "));
            if given.is_some_and(|given| token.is(given)) {
                None
            } else {
                forbidden(
                    "the token is missing or wrong; open the address that the program printed, with all that follows `#`",
                )
            }
        }
        _ => Some(Response::text(405, "only GET and POST are supported")),
    }
}

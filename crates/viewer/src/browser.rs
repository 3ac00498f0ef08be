//! Leads the user's browser to the server.

use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use tempfile::NamedTempFile;

/// The page that leads a browser to a server; the file goes with this value.
#[must_use]
pub struct Redirect(#[allow(dead_code, reason = "the file goes with it")] NamedTempFile);

/// The prefix of the name of a page that leads to a server.
const REDIRECT: &str = "use3d-view-";

/// Writes a page that leads to an address. Only this user can read it, while every user of a machine can read
/// the arguments of its processes, and the address ends with the key.
fn page_to(address: &str) -> std::io::Result<NamedTempFile> {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_dir());
    let folder = own.unwrap_or_else(std::env::temp_dir);
    use3d_files::sweep(&folder, REDIRECT, |_| true);
    let prefix = format!("{REDIRECT}{}-", use3d_files::unique());
    let mut page = tempfile::Builder::new().prefix(&prefix).suffix(".html").tempfile_in(folder)?;
    write!(
        page,
        "<!doctype html>\n<meta charset=\"utf-8\">\n<meta name=\"referrer\" content=\"no-referrer\">\n\
         <meta http-equiv=\"refresh\" content=\"0; url={address}\">\n<title>3D-USE</title>\n\
         <p><a href=\"{address}\">Open the viewer</a></p>\n"
    )?;
    page.flush()?;
    Ok(page)
}

/// Makes the system open an address, if there is a screen, and returns the page that leads to it, which is to
/// be kept as long as the server runs. A missing browser is no error, because the user knows the address.
pub fn open(address: &str) -> Option<Redirect> {
    let screen = ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some());
    let (program, arguments): (&str, &[&str]) = if cfg!(target_os = "macos") {
        ("open", &[])
    } else if cfg!(windows) {
        ("cmd", &["/c", "start", ""])
    } else if screen {
        ("xdg-open", &[])
    } else {
        return None;
    };
    let no_page =
        |error: &std::io::Error| tracing::debug!("no page that leads a browser to the viewer: {error}");
    let page = page_to(address).inspect_err(no_page).ok()?;
    let mut command = Command::new(program);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    match command.args(arguments).arg(page.path()).spawn() {
        // A thread waits for the child, so that no zombie process is left.
        Ok(mut child) => drop(std::thread::spawn(move || child.wait())),
        Err(error) => tracing::debug!("{program}: {error}"),
    }
    Some(Redirect(page))
}

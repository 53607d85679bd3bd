//! A port that stays while servers behind it come and go.

use std::io;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::thread;

use crate::process::Server;

/// Carries bytes to the server of the moment and back, until the process ends.
pub struct Relay {
    address: SocketAddr,
    /// "127.0.0.1:…"; None while there is none.
    behind: Arc<Mutex<Option<String>>>,
}

impl Relay {
    /// In front of this server.
    pub fn before(server: &Server) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("an address");
        let behind = Arc::new(Mutex::new(Some(server.address().host)));
        let target = behind.clone();
        thread::spawn(move || {
            for near in listener.incoming().map_while(Result::ok) {
                let far = target.lock().expect("no panic").clone().and_then(|host| TcpStream::connect(host).ok());
                // Dropped, it is closed: nobody is there.
                if let Some(far) = far {
                    carry(&near, &far);
                    carry(&far, &near);
                }
            }
        });
        Self { address, behind }
    }

    /// Instead of the server's own.
    pub fn url(&self, server: &Server) -> String {
        server.url.replace(&server.address().host, &self.address.to_string())
    }

    /// Who connects from now on comes to this server, or to none.
    pub fn lead_to(&self, server: Option<&Server>) {
        *self.behind.lock().expect("no panic") = server.map(|server| server.address().host);
    }
}

fn carry(from: &TcpStream, to: &TcpStream) {
    let (mut from, mut to) = (from.try_clone().expect("a socket"), to.try_clone().expect("a socket"));
    thread::spawn(move || {
        let _ = io::copy(&mut from, &mut to);
        let _ = to.shutdown(Shutdown::Write);
        let _ = from.shutdown(Shutdown::Read);
    });
}

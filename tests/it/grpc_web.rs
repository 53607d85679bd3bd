//! gRPC-Web over HTTP/1.1 as a browser speaks it, with nothing but a socket: one call a connection, calls up and streams down.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use prost::Message;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tonic::metadata::MetadataMap;
use tonic::{Code, Status};

use crate::process::ServerAddress;

/// Flag of the last piece, which holds the trailers.
const TRAILERS: u8 = 0x80;

/// A connection, encrypted or not.
trait Socket: AsyncRead + AsyncWrite + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Send + Unpin> Socket for S {}

/// A call that was sent; its answer is read piece by piece.
pub struct Answer {
    /// Dropped with the answer: the server then sees the client leave.
    stream: BufReader<Box<dyn Socket>>,
    /// Of the current chunk, not read yet.
    chunk_left: usize,
    /// A call that failed before its first message says so in its head.
    failed: Option<Status>,
}

/// Sends one message to "Rendering/OpenSession" and reads the head of the answer.
pub async fn call(server: &ServerAddress, method: &str, message: &impl Message) -> Answer {
    let (address, mut socket) = connect(server).await;
    let body = message.encode_to_vec();
    let head = format!(
        "POST /lumisphere.v1alpha1.{method} HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/grpc-web+proto\r\nX-Grpc-Web: 1\r\n\
         Content-Length: {}\r\n\r\n\0",
        body.len() + 5
    );
    let length = u32::try_from(body.len()).expect("messages are small").to_be_bytes();
    socket.write_all(&[head.as_bytes(), &length, &body].concat()).await.expect("the server reads");
    let mut stream = BufReader::new(socket);
    let status_line = line(&mut stream).await;
    assert_eq!(status_line, "HTTP/1.1 200 OK");
    let mut headers = HashMap::new();
    loop {
        match line(&mut stream).await {
            end if end.is_empty() => break,
            header => headers.extend(header.split_once(": ").map(|(name, value)| (name.to_ascii_lowercase(), value.to_string()))),
        }
    }
    let failed = status(&headers).filter(|s| s.code() != Code::Ok);
    Answer { stream, chunk_left: 0, failed }
}

/// The server's address, and a connection to it.
async fn connect(server: &ServerAddress) -> (&str, Box<dyn Socket>) {
    let address = server.host.as_str();
    let tcp = TcpStream::connect(address).await.expect("the server listens");
    let Some(certificate) = &server.certificate else { return (address, Box::new(tcp)) };
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(certificate).expect("the certificate is kept")).expect("a certificate");
    let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().expect("versions");
    let config = config.with_root_certificates(roots).with_no_client_auth();
    let name = "127.0.0.1".try_into().expect("a name");
    (address, Box::new(TlsConnector::from(Arc::new(config)).connect(name, tcp).await.expect("the handshake succeeds")))
}

/// The one answer of a call.
pub async fn unary<R: Message + Default>(server: &ServerAddress, method: &str, message: &impl Message) -> Result<R, Status> {
    let mut answer = call(server, method, message).await;
    let first = answer.message().await?.expect("one message");
    assert!(answer.message::<R>().await?.is_none(), "one message only");
    Ok(first)
}

impl Answer {
    /// The next message; None once the trailers said OK.
    pub async fn message<R: Message + Default>(&mut self) -> Result<Option<R>, Status> {
        if let Some(status) = self.failed.take() {
            return Err(status);
        }
        let head = self.bytes(5).await;
        let length = u32::from_be_bytes(head[1..].try_into().expect("four bytes")) as usize;
        let body = self.bytes(length).await;
        if head[0] & TRAILERS == 0 {
            return Ok(Some(R::decode(Bytes::from(body)).expect("the message decodes")));
        }
        let text = String::from_utf8(body).expect("trailers are text");
        let trailers = text.lines().filter_map(|l| l.split_once(':')).map(|(name, value)| (name.to_string(), value.trim().to_string()));
        match status(&trailers.collect()).expect("trailers have a status") {
            status if status.code() == Code::Ok => Ok(None),
            status => Err(status),
        }
    }

    /// Out of the chunks of the body.
    async fn bytes(&mut self, count: usize) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(count);
        while bytes.len() < count {
            if self.chunk_left == 0 {
                let size = line(&mut self.stream).await;
                self.chunk_left = usize::from_str_radix(&size, 16).unwrap_or_else(|e| panic!("{e}: a chunk's size expected, not {size:?}"));
                assert!(self.chunk_left > 0, "the body ended without trailers");
            }
            let mut piece = vec![0; self.chunk_left.min(count - bytes.len())];
            self.stream.read_exact(&mut piece).await.expect("the chunk is whole");
            self.chunk_left -= piece.len();
            bytes.extend(piece);
            if self.chunk_left == 0 {
                assert_eq!(line(&mut self.stream).await, "", "a chunk ends its line");
            }
        }
        bytes
    }
}

async fn line(reader: &mut BufReader<Box<dyn Socket>>) -> String {
    let mut line = String::new();
    reader.read_line(&mut line).await.expect("the server answers");
    line.trim_end().into()
}

/// As tonic reads it, with its details.
fn status(headers: &HashMap<String, String>) -> Option<Status> {
    let pairs = headers.iter().filter(|(name, _)| name.starts_with("grpc-"));
    let mut map = MetadataMap::new().into_headers();
    map.extend(pairs.filter_map(|(name, value)| Some((Some(name.parse().ok()?), value.parse().ok()?))));
    Status::from_header_map(&map)
}

//! Calls any rpc with bytes for messages.

use std::time::Duration;

use bytes::{Buf, BufMut};
use prost_reflect::MethodDescriptor;
use tokio::time::timeout;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::transport::Channel;
use tonic::{Request, Status};

use crate::process::PATIENCE;

/// Messages of an answer that are waited for, each for so long: streams may go on for ever, and be silent.
const MESSAGES: usize = 3;
const SILENCE: Duration = Duration::from_millis(50);

#[derive(Debug, Clone, Default)]
struct Raw;

impl Codec for Raw {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, item: Vec<u8>, out: &mut EncodeBuf<'_>) -> Result<(), Status> {
        out.put_slice(&item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, input: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let bytes = input.copy_to_bytes(input.remaining());
        Ok(Some(bytes.to_vec()))
    }
}

/// The first messages of the answer, or how the call ended.
pub async fn call(channel: Channel, method: &MethodDescriptor, messages: Vec<Vec<u8>>) -> Result<Vec<Vec<u8>>, Status> {
    let mut client = tonic::client::Grpc::new(channel).max_decoding_message_size(lumisphere_proto::MAX_FRAME_MESSAGE_BYTES);
    client.ready().await.map_err(|error| Status::unavailable(error.to_string()))?;
    let path = format!("/{}/{}", method.parent_service().full_name(), method.name()).parse().expect("a path");
    let mut request = Request::new(tokio_stream::iter(messages));
    request.set_timeout(Duration::from_secs(2));
    let mut stream = client.streaming(request, path, Raw).await?.into_inner();
    let mut answers = Vec::new();
    while answers.len() < MESSAGES
        && let Ok(message) = timeout(if method.is_server_streaming() { SILENCE } else { PATIENCE }, stream.message()).await
        && let Some(message) = message?
    {
        answers.push(message);
    }
    Ok(answers)
}

//! Many sessions for a long time, some of them mute.

use std::time::{Duration, Instant};

use super::{Server, Stand, Viewer, bound, quantile};

const SESSIONS: u64 = 200;

pub async fn soak(server: &Server, stand: &Stand) {
    let seconds = std::env::var("SOAK_SECONDS").map_or(600, |text| text.parse().expect("SOAK_SECONDS: a number"));
    let until = Duration::from_secs(seconds);
    let (mut mute, mut awake) = (Vec::new(), Vec::new());
    for number in 0..SESSIONS {
        let mut viewer = Viewer::open(server.rendering().await, *stand, (64, 48), 2).await;
        if number % 10 == 0 {
            // Neither reads nor acknowledges, but keeps its connection.
            viewer.step().await;
            viewer.step().await;
            mute.push(viewer);
        } else {
            awake.push(tokio::spawn(viewer.walk(until)));
        }
    }
    let begun = Instant::now();
    let mut memory: Vec<(f64, f64)> = Vec::new();
    while begun.elapsed() < until {
        tokio::time::sleep(until / 60).await;
        // The first part fills pools and heaps.
        if begun.elapsed() > until / 5 {
            memory.push((begun.elapsed().as_secs_f64() / 60.0, 1e-6 * server.resident_bytes() as f64));
        }
    }
    let mut rates = Vec::new();
    for viewer in awake {
        rates.push(viewer.await.expect("a viewer does not panic"));
    }
    let count = memory.len() as f64;
    let (x, y) = (memory.iter().map(|m| m.0).sum::<f64>() / count, memory.iter().map(|m| m.1).sum::<f64>() / count);
    let slope = memory.iter().map(|m| (m.0 - x) * (m.1 - y)).sum::<f64>() / memory.iter().map(|m| (m.0 - x).powi(2)).sum::<f64>();
    let (least, median) = (quantile(&mut rates, 0.0), quantile(&mut rates, 0.5));
    println!("\nsoak: {seconds} s, {y:.1} MB on average; frames/s of who reads: least {least:.2}, median {median:.2}");
    bound("megabytes a minute", slope, 1.0, slope <= 1.0);
    bound("least / median frames", least / median, 0.5, least >= 0.5 * median);
    let mut ended = 0;
    for mut viewer in mute {
        // What had come before it was ended, then the end.
        let end = async { while viewer.down.message().await.is_ok_and(|message| message.is_some()) {} };
        ended += u64::from(tokio::time::timeout(Duration::from_secs(5), end).await.is_ok());
    }
    bound("mute ones ended", ended as f64, (SESSIONS / 10) as f64, ended == SESSIONS / 10);
}

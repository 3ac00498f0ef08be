//! Networks trained by others, in pure Rust: Nu2Net, Depth Anything V2, LPIPS, RAFT, URanker, MUSIQ

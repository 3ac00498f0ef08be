//! Every network gives the same bits for any number of threads.

use use3d_capture::Image;
use use3d_nets::weights::StandIn;
use use3d_nets::{DepthAnythingSize, DepthAnythingV2, Lpips, Musiq, Nu2Net, Raft, URanker};
use use3d_numerics::random::{Purpose, Stream};

fn picture(seed: u64, width: usize, height: usize) -> Image {
    let stream = Stream::new(seed, Purpose::new("picture"), 0);
    let mut image = Image::new(width, height);
    image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = stream.uniform(i as u64) as f32);
    image
}

/// Checks that the results on 1, 2 and 5 threads are equal.
fn check<T: PartialEq + Send>(run: impl Fn() -> T + Sync) {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(&run)
    };
    let one = on(1);
    for threads in [2, 5] {
        assert!(on(threads) == one, "{threads} threads differ from one");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let (a, b) = (picture(1, 136, 129), picture(2, 136, 129));
    let nu2net = Nu2Net::from_weights(&mut StandIn).unwrap();
    check(|| nu2net.enhance(&a).unwrap());
    let lpips = Lpips::from_weights(&mut StandIn, &mut StandIn).unwrap();
    check(|| lpips.distance(&a, &b).unwrap());
    check(|| lpips.distance_map(&a, &b).unwrap());
    let raft = Raft::from_weights(&mut StandIn).unwrap();
    check(|| raft.flow_with(&a, &b, 2).unwrap());
    let uranker = URanker::from_weights(&mut StandIn).unwrap();
    check(|| uranker.score(&a).unwrap());
    let musiq = Musiq::from_weights(&mut StandIn).unwrap();
    check(|| musiq.score(&a).unwrap());
    let depth = DepthAnythingV2::from_weights(DepthAnythingSize::Small, &mut StandIn).unwrap();
    check(|| depth.disparity_at(&a, 112).unwrap());
}

"""From a recording to what stays of its scene: keyframes, depths, the atlas, the store on disk."""

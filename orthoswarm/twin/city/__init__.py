"""The simulated ground: a procedural city or a real place, its texture, buildings, trees and light."""

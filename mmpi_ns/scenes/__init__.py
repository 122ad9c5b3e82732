from mmpi_ns.scenes.catalogue import make_scene

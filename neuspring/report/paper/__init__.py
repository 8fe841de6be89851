"""Pictures for papers: film strips (`strip`), stiffness and regions (`body`), short animations (`film`), from any side (`look`)."""

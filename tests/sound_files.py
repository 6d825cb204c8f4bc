"""Small valid files of formats whose real ones are large or not ours."""

DBAT = {
    "a.xml": """<?xml version="1.0" encoding="utf-8"?>
<document dbat_script_version="1.0"><meta><name>small</name><project_unit>m</project_unit></meta>
<input base_dir="$HERE">
<ctrl_pts><file format="id,label,x,y,z,sxyz">control.txt</file><filter id="11,12">keep</filter></ctrl_pts>
<images><file format="id,path">images.txt</file></images>
<image_pts><file format="im,id,x,y" sxy="0.5">points.txt</file></image_pts>
<cameras><camera><name>one</name><unit>mm</unit><sensor>auto,5.4</sensor><image>2272,1704</image><focal>7.5</focal>
<model>3</model><nK>3</nK><nP>2</nP><K>0,0,0</K><pp>0,0</pp></camera></cameras></input>
<operations><operation><set_initial_values><io><all>default</all></io></set_initial_values></operation>
<operation><set_bundle_estimate_params><io><all>true</all><skew>false</skew></io><eo>true</eo><op>true</op>
</set_bundle_estimate_params></operation></operations></document>
""",
    "control.txt": "11,a,1.0,2.0,3.0,0.01\n12,b,1.5,2.5,3.0,0.01\n",
    "images.txt": "1,a/one.jpg\n2,a/two.jpg\n",
    "points.txt": "1,11,100.5,200.25\n1,12,300.5,200.25\n2,11,150.5,210.0\n2,12,350.5,210.0\n",
}
PHOTOMODELER = {
    "a.txt": "small\n0.0005 20 2272 1704\n1 0.1 10 10 10 10 20 20 20\n7.5 3.6 2.7 7.2 5.4 0.005 0 0 -0.0001 0.0002\n"
    "0 0.05 0.05 1 1 1 1 1 1 1\n"
    + "".join(
        f"{k} {name}.jpg\n{k} {k} 2.0 3.0 10.0 5.0 -4.0\n{k} 1 1 1 1 1 1\n\n"
        f"{k} 7.5 3.6 2.7 7.2 5.4 0.005 0 0 -0.0001 0.0002\n{k} 0 0.05 0.05 1 1 1 1 1 1 1\n"
        for k, name in enumerate(("one", "two"))
    )
    + "\n11 1.0 2.0 0.0 0.01 0.01 0.01\n\n11 1.0 2.0 0.0 0.01 0.01 0.01\n12 2.0 2.0 0.5 0.01 0.01 0.01\n\n"
    "0 11 100.5 200.25 1 1\n0 12 300.5 200.25 1 1\n1 11 150.5 210.0 1 1\n1 12 350.5 210.0 1 1\n\n1 1 11\n\n0 1\n",
    "ctrlpts-weighted.txt": DBAT["control.txt"].replace(",0.01", ",0.01,0.01,0.01"),
    "fake-camera-positions.txt": "one.jpg,1.0,2.0,3.0,0.5\ntwo.jpg,2.0,2.0,3.0,0.5\n",
}


MARKS = (
    "1\t268619.354051\t[2129]\t    24,N\t     9,E\t   193,V\t-21.97273819,Lat\t113.93433129,Lon\t91.071,Ellh\t"
    "1.056360, 1.085926, 3.245131\t16,Q\n"
    "2\t268621.283927\t[2129]\t    20,N\t    15,E\t   193,V\t-21.97253139,Lat\t113.93438555,Lon\t91.182,Ellh\t"
    "0.012977, 0.011731, 0.031695\t50,Q\n"
)
POS = """% program   : RTKPOST ver.2.4.3
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)
2021/03/10 09:12:01.200   47.480948244   19.056512467   177.0515   1   9   0.0065   0.0064   0.0144
2021/03/10 09:12:03.400   47.480947993   19.056507472   176.6958   2   9   0.1220   0.1519   0.4474
2148 292325.200   47.480947993   19.056507472   176.6958   5   5
"""
EXPOSURES = """# of a flight
image,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg,sigma_X_m,sigma_Y_m,sigma_Z_m,sigma_omega_deg,sigma_phi_deg,sigma_kappa_deg,fix
a.JPG,500010.5,6170000.25,120.5,1.5,-2.25,91,0.02,0.02,0.04,0.1,0.1,0.5,fixed
b.JPG,500030.5,6170000.75,120.75,0.5,-1.25,90,,,,,,,
"""
